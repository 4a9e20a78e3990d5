"""The soak of the benchmark: a small graph, a short while, over real DDS."""

from __future__ import annotations

import math

import pytest

pytest.importorskip("rclpy")

from rotavg_ros.ros.harness import soak

pytestmark = pytest.mark.ros


def test_a_node_under_load(monkeypatch: pytest.MonkeyPatch) -> None:
    for variable in ("ROS_DOMAIN_ID", "ROS_AUTOMATIC_DISCOVERY_RANGE"):
        monkeypatch.setenv(variable, "")  # the soak chooses; this puts them back
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
