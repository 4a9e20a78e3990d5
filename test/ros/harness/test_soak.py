"""The soak of the benchmark: a small graph, a short while, over real DDS."""

from __future__ import annotations

import math
import os

import pytest

pytest.importorskip("rclpy")

from rotavg_ros.ros.harness import small_robots, soak

pytestmark = pytest.mark.ros


@pytest.fixture(autouse=True)
def _domain(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(variable, "")  # the soak chooses; this puts them back


@pytest.mark.large
@pytest.mark.skipif(len(os.sched_getaffinity(0)) < 2, reason="this process may use one core alone")
def test_a_node_on_one_core_and_on_two() -> None:
    rows = small_robots.run([80], 2.0)
    assert [row.cores for row in rows] == [1, 2]
    for row in rows:
        assert row.cpu_share < row.cores + 0.1
        assert row.node_mb > 50 and row.solver_mb > 50  # each has torch loaded
        assert 100 < row.both_mb < 0.9 * (row.node_mb + row.solver_mb)  # and it is the same one
    assert small_robots.table(rows).to_markdown().count("\n| 8") == 2


def test_a_node_under_load() -> None:
    (row,) = soak.run(80, 3.0, rates_hz=(50.0,))
    assert 80 <= row.keyframes <= 92
    assert row.edges >= row.keyframes - 1
    assert 0 < row.sent <= 150
    assert row.lost == 0
    assert row.cpu_share > 0
    for milliseconds in (row.tick_p50_ms, row.callback_p95_ms, row.latency_p95_ms):
        assert math.isfinite(milliseconds) and milliseconds > 0
    assert row.tick_p50_ms <= row.tick_p95_ms <= row.tick_max_ms
    assert "| 50 | " in soak.table([row]).to_markdown()
