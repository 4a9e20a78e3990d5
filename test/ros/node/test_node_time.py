"""Simulated time and time that goes back, over real DDS."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from rosgraph_msgs.msg import Clock

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")


def test_a_bag_that_is_played_again_begins_a_component(live_node, tmp_path) -> None:
    """And what was autosaved is still in the file."""
    path = tmp_path / "state" / "state.npz"
    path.parent.mkdir()
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}", "autosave_period_s:=0.2")
    live_node.turn(0, 30)
    first = live_node.wait_for_silence()
    live_node.turn(0, 20)
    live_node.spin_until(lambda: live_node.status["time jumps"] == "1")
    again = live_node.wait_for_silence()
    assert list(again.keyframe_ids) == list(range(50)) and list(again.stamps_ns[30:]) == list(again.stamps_ns[:20])
    assert list(again.components) == [0] * 30 + [1] * 20
    assert list(again.orientations)[: 4 * 30] == pytest.approx(list(first.orientations), abs=1e-9)
    assert again.header.stamp == Time(sec=1019)
    assert live_node.status["dropped"] == "0"
    told = (1, "time went back: the graph is kept, and a new component begins (on_time_jump)")
    assert any(level == told[0] and told[1] in message for level, message in live_node.said)
    assert live_node.stop() == 0
    assert len(np.load(path)["keyframe_id"]) == 50 and os.listdir(path.parent) == ["state.npz"]


@pytest.mark.large
def test_what_reset_and_load_discard_is_kept_beside_the_state_file(live_node, tmp_path) -> None:
    path = tmp_path / "state.npz"
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}", "autosave_period_s:=0.2", "on_time_jump:=reset")

    def told(number: int) -> Path:
        """The backup, once the diagnostics have named it in a warning."""
        backup = tmp_path / f"state.npz.bak-{number:04}"
        live_node.spin_until(lambda: str(backup) in live_node.status["message"] and live_node.status["level"] == "1")
        return backup

    live_node.turn(0, 30)
    live_node.wait_for_silence()
    live_node.turn(0, 20)
    assert len(np.load(told(1))["keyframe_id"]) == 30
    live_node.wait_for_silence()
    assert live_node.call("reset").success
    assert len(np.load(told(2))["keyframe_id"]) == 20
    live_node.turn(0, 10)
    live_node.wait_for_silence()
    np.savez(path, **np.load(tmp_path / "state.npz.bak-0001"))
    loaded = live_node.call("load")
    assert loaded.success and "loaded 30 keyframes" in loaded.message, loaded.message
    assert len(np.load(told(3))["keyframe_id"]) == 10
    live_node.spin_until(lambda: live_node.status["keyframes"] == "30")


@pytest.mark.large
def test_with_reset_a_bag_that_is_played_again_begins_a_new_graph(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "on_time_jump:=reset")
    live_node.turn(0, 30)
    first = live_node.wait_for_silence()
    count = len(live_node.answers)
    live_node.turn(0, 20)
    live_node.spin_until(lambda: live_node.status["time jumps"] == "1")
    again = live_node.wait_for_silence()
    assert list(again.keyframe_ids) == list(range(20))
    assert list(again.orientations) == pytest.approx(list(first.orientations)[: 4 * 20], abs=1e-9)
    assert live_node.status["dropped"] == "0" and "time went back" in live_node.process.output
    # What follows the old answer is an empty one, or at once the new graph's: never more of the old one.
    assert all(len(answer.keyframe_ids) <= 20 for answer in live_node.answers[count:])


@pytest.mark.large
def test_a_clock_that_goes_back_is_an_error_where_that_is_asked_for(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "on_time_jump:=error")
    live_node.turn(0, 10)
    live_node.wait_for_silence()
    live_node.turn(0, 9)
    live_node.spin_until(lambda: live_node.status["level"] == "2")
    assert "call ~/reset" in live_node.status["message"] and live_node.status["keyframes"] == "10"
    assert live_node.call("reset").success
    live_node.turn(0, 9)
    live_node.spin_until(lambda: live_node.status["keyframes"] == "9" and live_node.status["level"] != "2")


@pytest.mark.parametrize(
    ("policy", "kept"), [pytest.param("new_component", "33", marks=pytest.mark.large), ("reset", "3")]
)
def test_simulated_time_that_restarts(live_node, policy: str, kept: str) -> None:
    """The clock tells it before any odometry does; a clock that stands still in between stops nothing."""
    live_node.start(*EVERY_MESSAGE, "use_sim_time:=true", f"on_time_jump:={policy}")
    clock = live_node.probe.create_publisher(Clock, "/clock", 10)

    def with_clock_at(seconds: int, condition: Callable[[], bool]) -> None:
        """Publish the time as long as it takes, for the clock's messages may get lost."""
        clock.publish(Clock(clock=Time(sec=seconds)))
        live_node.spin_until(lambda: condition() or clock.publish(Clock(clock=Time(sec=seconds))))

    with_clock_at(1030, lambda: live_node.reported_at == Time(sec=1030))
    live_node.turn(0, 30)
    assert len(live_node.wait_for_silence().keyframe_ids) == 30
    with_clock_at(1000, lambda: live_node.status["time jumps"] == "1")
    if policy == "reset":
        live_node.spin_until(lambda: len(live_node.answers[-1].keyframe_ids) == 0)
    live_node.turn(0, 3)
    live_node.spin_until(lambda: live_node.status["keyframes"] == kept)
