"""OK, WARN and ERROR mean something."""

from __future__ import annotations

import itertools
import time
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from diagnostic_msgs.msg import DiagnosticStatus

from rotavg_ros.online import KeyframeReference
from rotavg_ros.online.content import Counts
from rotavg_ros.ros.node.diagnostics import BEGAN_ANEW, Reporter
from rotavg_ros.ros.node.health import Health
from rotavg_ros.ros.node.message_counting import TopicCounter
from rotavg_ros.settings.parameters import NodeParameters

OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"


def answer(**changes: object) -> SimpleNamespace:
    values = {
        "version": 3,
        "kind": np.array([0, 1, 1, 1]),
        "outlier": np.array([False, True, False, False]),
        "num_components": 1,
        "device": "cpu",
        "profile": "slam",
        "method": "neurora",
        "was_cold": True,
        "warnings": (),
    }
    return SimpleNamespace(**values | changes)


@pytest.fixture(autouse=True)
def _a_millisecond_a_look(monkeypatch: pytest.MonkeyPatch) -> None:
    """However long this process waits for a core."""
    begin, looks = time.monotonic(), itertools.count()
    monkeypatch.setattr(time, "monotonic", lambda: begin + 1e-3 * next(looks))


@pytest.fixture
def health() -> Health:
    now = time.monotonic()
    healthy = Health(last_odometry={"/odom": now}, answer=answer(), answered=now)
    healthy.odometry["/odom"] = TopicCounter()
    healthy.ticks.add(0.1)
    return healthy


def report(health: Health, parameters: NodeParameters | None = None, paused: bool = False, **rejected: int):
    counts = Counts(keyframes=10, edges=12, pending=1, rejected=rejected)
    return Reporter("rotavg: estimator").report(health, counts, parameters or NodeParameters(), paused)


def values_of(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_all_is_well(health: Health) -> None:
    status = report(health, duplicate_edge=4)
    assert (status.level, status.message, status.hardware_id) == (OK, "ok", "cpu")
    values = {pair.key: pair.value for pair in status.values}
    assert values["loop closures"] == "3" and values["outliers"] == "1" and values["dropped duplicate_edge"] == "4"
    assert values["tick p50 ms"] == "100.0" and values["answer cold"] == "true"
    assert report(health, paused=True).message == "paused"


@pytest.mark.parametrize(
    ("changes", "level", "message"),
    [
        ({"mistakes": ["nobody publishes /odom"]}, WARN, "nobody publishes /odom"),
        ({"answer": answer(num_components=2)}, WARN, "2 components"),
        ({"answer": answer(warnings=("3 of 4 are flagged", "inverted"))}, WARN, "3 of 4 are flagged; inverted"),
        ({"failure": "no memory"}, ERROR, "solving fails: no memory"),
        ({"unsolved_since": -100.0}, ERROR, "stale"),
    ],
)
def test_what_is_wrong_is_said(health: Health, changes: dict[str, object], level: bytes, message: str) -> None:
    for name, value in changes.items():
        setattr(health, name, time.monotonic() + value if isinstance(value, float) else value)
    status = report(health)
    assert status.level == level and message in status.message


def test_an_answer_is_stale_from_the_first_comparison_that_finds_it_behind(health: Health) -> None:
    health.answered, *looks = (time.monotonic() - before for before in (200.0, 100.0, 50.0))
    for began in looks:
        health.compared(began, is_behind=True)
    assert health.unsolved_since == looks[0] and "stale by 100 s" in report(health).message
    assert values_of(report(health))["answer behind"] == "true"
    health.published(answer(seconds=0.1))  # while the third comparison is on its way
    health.compared(looks[1], is_behind=True)
    assert health.unsolved_since == looks[1]
    health.compared(time.monotonic(), is_behind=False)
    assert health.unsolved_since is None and report(health).level == OK
    assert values_of(report(health))["answer behind"] == "false"


@pytest.mark.parametrize(
    ("seconds", "level", "message"), [(30.0, WARN, "code is compiled"), (400.0, ERROR, "stale by 400 s")]
)
def test_the_first_answer_may_take_its_time(health: Health, seconds: float, level: bytes, message: str) -> None:
    health.answer, health.unsolved_since = None, time.monotonic() - seconds
    status = report(health)
    assert status.level == level and message in status.message


def test_warnings_about_an_answer_stay_until_one_has_none(health: Health) -> None:
    health.answer = answer(warnings=("all would agree inverted",))
    assert [report(health).level for _ in range(3)] == [WARN] * 3
    health.answer = answer()
    assert (report(health).level, report(health).message) == (OK, "ok")


def test_silence_is_told_of_each_topic(health: Health) -> None:
    health.odometry["/b/odom"] = TopicCounter()
    health.started = time.monotonic() - 100
    assert report(health).message == "no odometry yet on /b/odom"
    health.last_odometry = {"/odom": health.started, "/b/odom": time.monotonic()}
    assert report(health).message == "no odometry for 100 s on /odom"


def test_odometry_that_is_refused_is_not_called_silent(health: Health) -> None:
    health.started = time.monotonic() - 100
    health.last_odometry.clear()
    health.refused_odometry("/odom", "repeated_stamp")
    assert report(health).message == "all odometry on /odom has been refused for 100 s (repeated_stamp)"
    health.last_odometry["/odom"] = time.monotonic() - 10
    assert report(health).message == "all odometry on /odom has been refused for 10 s (repeated_stamp)"
    health.last_odometry["/odom"] = time.monotonic()
    assert report(health).message == "ok"
    health.last_odometry["/odom"], health.last_refusal["/odom"] = health.started, (health.started + 1, "future_stamp")
    assert report(health).message == "no odometry for 100 s on /odom"


@pytest.mark.parametrize(("of", "told"), [("is_full", "no new keyframes"), ("is_full_of_edges", "no new edges")])
def test_a_full_graph_is_told_with_what_it_is_full_of(health: Health, of: str, told: str) -> None:
    counts = Counts(10, 12, 0, {}, **{of: True})
    status = Reporter("rotavg: estimator").report(health, counts, NodeParameters(), False)
    assert status.level == WARN and status.message.startswith("the graph is full") and told in status.message


def test_edges_that_wait_for_what_hardly_comes(health: Health) -> None:
    def of(**counts: object) -> str:
        reporter = Reporter("rotavg: estimator")
        return reporter.report(
            health, Counts(10, 12, 7, {}, robots=("robot",), **counts), NodeParameters(), False
        ).message

    assert of() == of(pending_by_robot={"robot": 7}) == "ok"
    unknown = of(pending_by_robot={"robot": 3, "roboter": 4})
    assert unknown.startswith("4 edges are about robots that are not known ('roboter'); known are robot: ")
    by_id = KeyframeReference("robot", 900)
    assert of(longest_pending=by_id, longest_pending_s=1.0) == "ok"
    assert "such as 900 of robot" in of(longest_pending=by_id, longest_pending_s=100.0)
    assert "one clock" in of(longest_pending=KeyframeReference("robot", None, 5), longest_pending_s=100.0)


def test_closures_that_wait_to_be_solved(health: Health) -> None:
    status = Reporter("rotavg: estimator").report(health, Counts(10, 12, 0, {}, queued=20), NodeParameters(), False)
    assert status.level == WARN and "at once than a tick takes in: 20 wait to be solved" in status.message
    assert {pair.key: pair.value for pair in status.values}["queued closures"] == "20"


def test_closures_that_will_not_be_sent_on_are_counted(health: Health) -> None:
    health.held_back, health.held_back_dropped = 4, 3
    values = {pair.key: pair.value for pair in report(health).values}
    assert (values["held back"], values["held back dropped"]) == ("4", "3")


def test_slow_solves_losses_and_refusals_warn(health: Health) -> None:
    health.ticks.add(20.0)
    assert "longer" in report(health).message
    refused = report(health, nan_rotation=2, odometry_gap=1, duplicate_edge=5).message
    assert "3 inputs refused (nan_rotation, odometry_gap)" in refused
    for number in (1, 4):
        health.odometry["/odom"].by_sequence.observe("", number)
    assert "2 messages lost" in report(health).message


def test_odometry_that_queues_makes_the_present_pose_late(health: Health) -> None:
    """At 1 kHz the pose came seconds late, and all was said to be well."""
    for seconds in (0.01, 0.02, 5.0):  # one pause is none
        health.odometry_wait.add(seconds)
    assert report(health).level == OK
    for _ in range(4):
        health.odometry_wait.add(3.0)
    status = report(health)
    assert status.level == WARN and "odometry waits 3.0 s in its queue" in status.message


def test_a_front_end_that_has_begun_anew_is_told_of_for_a_minute(health: Health) -> None:
    """Each of its refusals passes in a second, and what to do is not in their counts."""
    reporter = Reporter("rotavg: estimator")

    def message(**rejected: int) -> str:
        return str(reporter.report(health, Counts(10, 12, 0, rejected), NodeParameters(), False).message)

    assert "front end" not in message(nan_rotation=1)
    assert "call ~/reset" in message(nan_rotation=1, contradictory_odometry=1)
    assert message(nan_rotation=1, contradictory_odometry=1) == BEGAN_ANEW
    health.notices = {text: noted - 61 for text, noted in health.notices.items()}
    assert message(nan_rotation=1, contradictory_odometry=1) == "ok"


def test_a_graph_without_odometry_does_not_miss_it(health: Health) -> None:
    health.last_odometry.clear()
    health.started = time.monotonic() - 100
    assert report(health, NodeParameters().changed({"keyframe_source": "edges"})).level == OK
    assert report(health, NodeParameters().changed({"unknown_keyframes": "create"})).level == OK


def test_before_the_first_answer() -> None:
    values = {pair.key: pair.value for pair in report(Health()).values}
    assert values["answer age s"] == values["tick p95 ms"] == values["answer cold"] == "nan"
