"""Services and live parameters over real DDS."""

from __future__ import annotations

import math
import os
import signal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rcl_interfaces.srv import DescribeParameters, SetParameters, SetParametersAtomically
from rclpy.parameter import Parameter
from rotavg_msgs.msg import KeyframeReference, RelativeRotation
from rotavg_msgs.srv import LabelEdge
from std_srvs.srv import SetBool

from rotavg_ros.ros.node.output.conversions import to_quaternion_message

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
HOUR = "solve_period_s:=3600.0"


def odometry(index: int) -> Odometry:
    message = Odometry()
    message.header.stamp = Time(sec=index)
    x, y, z, w = Rotation.from_rotvec([0.1, 0, 0.2 * index]).as_quat().tolist()
    message.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    return message


def edge(edge_id: int, source: int, target: int, wrong_rad: float = 0.0) -> RelativeRotation:
    true = Rotation.from_rotvec([0.1, 0, 0.2 * source]).inv() * Rotation.from_rotvec([0.1, 0, 0.2 * target])
    x, y, z, w = (true * Rotation.from_rotvec([0, wrong_rad, 0])).as_quat().tolist()
    return RelativeRotation(
        id=edge_id,
        source=KeyframeReference(id=source),
        target=KeyframeReference(id=target),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
        kind=RelativeRotation.LOOP_CLOSURE,
    )


def feed(live_node, start: int, stop: int) -> None:
    for index in range(start, stop):
        live_node.odometry.publish(odometry(index))


def wait_for(live_node, key: str, value: object) -> None:
    live_node.status.clear()
    live_node.spin_until(lambda: live_node.status.get(key) == str(value))


def outlier(live_node, edge_id: int) -> bool:
    flags = live_node.flags[-1]
    return bool(np.array(flags.outliers)[np.array(flags.edge_ids) == edge_id][0])


@pytest.mark.large
def test_solve_now_answers_with_its_solution_and_only_if_something_is_new(live_node) -> None:
    live_node.start(*EVERY_MESSAGE[:2], HOUR)
    feed(live_node, 0, 20)
    wait_for(live_node, "keyframes", 20)
    assert not live_node.answers
    response = live_node.call("solve_now")
    assert response.success and "20 keyframes" in response.message
    live_node.spin_until(lambda: bool(live_node.answers))
    assert len(live_node.answers[0].keyframe_ids) == 20
    assert "nothing has changed" in live_node.call("solve_now").message
    for service in ("save", "load"):
        refused = live_node.call(service)
        assert not refused.success and "state_file is empty" in refused.message


def test_reset_forgets_and_latches_an_empty_answer(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node, 0, 20)
    feed(live_node, 19, 20)  # the same stamp again
    wait_for(live_node, "dropped", 1)
    live_node.wait_for_silence()
    assert live_node.call("reset").success
    live_node.spin_until(lambda: len(live_node.answers[-1].keyframe_ids) == 0)
    wait_for(live_node, "keyframes", 0)
    # What was counted of the graph is forgotten with it, what was counted of messages is not.
    assert (live_node.status["dropped"], live_node.status["odometry messages"]) == ("0", "21")
    feed(live_node, 0, 10)  # the same stamps again: a bag that is played anew
    assert list(live_node.wait_for_silence().keyframe_ids) == list(range(10))
    assert live_node.status["dropped"] == "0"


@pytest.mark.large
def test_pause_keeps_what_comes_and_resume_solves_it(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    assert live_node.call("pause", SetBool, data=True).success
    feed(live_node, 0, 20)
    wait_for(live_node, "keyframes", 20)
    live_node.spin_for(0.5)
    assert not live_node.answers and live_node.status["paused"] == "true"
    assert len(live_node.orientations) == 20
    assert live_node.call("solve_now").success  # who asks for an answer gets it
    live_node.spin_until(lambda: bool(live_node.answers))
    feed(live_node, 20, 30)
    wait_for(live_node, "keyframes", 30)
    assert len(live_node.answers) == 1
    assert live_node.call("pause", SetBool, data=False).success
    assert len(live_node.wait_for_silence().keyframe_ids) == 30


def test_label_edge_decides_until_it_is_handed_back(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node, 0, 30)
    for edge_id, (source, target) in enumerate([(0, 20), (1, 22), (2, 25), (3, 28)], start=1):
        live_node.edges.publish(edge(edge_id, source, target))
    live_node.edges.publish(edge(9, 5, 29, wrong_rad=1.5))
    live_node.wait_for_silence(closures=5)
    assert outlier(live_node, 9) and not outlier(live_node, 2)
    for edge_id, label, expected in (
        (2, LabelEdge.Request.REJECT, True),
        (9, LabelEdge.Request.ACCEPT, False),
        (9, LabelEdge.Request.AUTOMATIC, True),
        (2, LabelEdge.Request.AUTOMATIC, False),
    ):
        assert live_node.call("label_edge", LabelEdge, edge_id=edge_id, label=label).success
        live_node.spin_until(lambda edge_id=edge_id, expected=expected: outlier(live_node, edge_id) == expected)
    live_node.wait_for_silence()
    assert outlier(live_node, 9) and not outlier(live_node, 2)
    unknown = live_node.call("label_edge", LabelEdge, edge_id=77, label=1)
    assert not unknown.success and "77" in unknown.message
    assert not live_node.call("label_edge", LabelEdge, edge_id=9, label=3).success


def test_a_node_that_was_killed_goes_on_where_it_was_saved(live_node, tmp_path) -> None:
    state = (f"state_file:={tmp_path / 'state.npz'}", "gauge:=identity")
    live_node.start(*EVERY_MESSAGE, *state)
    feed(live_node, 0, 20)
    before = live_node.wait_for_silence()
    response = live_node.call("save")
    assert response.success and "state.npz" in response.message
    live_node.stop(signal.SIGKILL)
    live_node.answers.clear()
    live_node.start(*EVERY_MESSAGE, *state)
    live_node.spin_until(lambda: bool(live_node.answers))
    after = live_node.answers[-1]
    assert after.keyframe_ids == before.keyframe_ids and after.stamps_ns == before.stamps_ns
    np.testing.assert_allclose(after.orientations, before.orientations, atol=1e-9)
    feed(live_node, 20, 25)
    wait_for(live_node, "keyframes", 25)  # the middleware may take seconds to serve a reader that has just come
    assert len(live_node.wait_for_silence().keyframe_ids) == 25


@pytest.mark.large
def test_a_robot_that_was_switched_off_and_on_begins_a_component(live_node, tmp_path) -> None:
    """Its clock begins in 1970, its odometry at zero; yesterday's map stays in the file."""
    state = (f"state_file:={tmp_path / 'state.npz'}", "autosave_period_s:=0.2")
    live_node.start(*EVERY_MESSAGE, *state)
    for index in range(5, 25):
        live_node.odometry.publish(odometry(1000 + index))
    live_node.wait_for_silence()
    assert live_node.stop() == 0
    live_node.answers.clear()
    live_node.start(*EVERY_MESSAGE, *state)
    for index in range(15):
        message = odometry(index)
        message.pose.pose.orientation = to_quaternion_message((0.0, 0.0, math.sin(0.1 * index), math.cos(0.1 * index)))
        live_node.odometry.publish(message)
    wait_for(live_node, "keyframes", 35)
    answer = live_node.wait_for_silence()
    assert list(answer.components) == [0] * 20 + [1] * 15
    flags = live_node.flags[-1]
    assert not any(
        (source < 20) != (target < 20) for source, target in zip(flags.source_ids, flags.target_ids, strict=True)
    )
    assert live_node.stop() == 0
    assert len(np.load(tmp_path / "state.npz")["keyframe_id"]) == 35


@pytest.mark.large
def test_a_state_file_of_another_robot_is_told_of(live_node, tmp_path) -> None:
    path = tmp_path / "state.npz"
    told = (
        "the state file is of robots that are not named in robots ('alice'): if it is another robot's, give this node "
        "a state_file of its own, else name them in robots and odometry_topics"
    )
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}", "robots:=['alice']")
    feed(live_node, 0, 10)
    live_node.wait_for_silence()
    assert live_node.call("save").success and live_node.call("load").success
    assert live_node.stop() == 0
    assert "state file is of" not in live_node.process.output
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}", "robots:=['bob']")
    live_node.spin_until(lambda: told in live_node.status["message"])
    assert live_node.status["level"] == "1" and live_node.status["keyframes"] == "10"
    assert live_node.process.output.count(told) == 1
    assert live_node.call("load").success
    assert live_node.process.output.count(told) == 2


@pytest.mark.large
def test_load_goes_back_and_refuses_a_broken_file(live_node, tmp_path) -> None:
    path = tmp_path / "state.npz"
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}")
    assert not live_node.call("load").success
    feed(live_node, 0, 10)
    live_node.wait_for_silence()
    assert live_node.call("save").success
    feed(live_node, 10, 20)
    live_node.wait_for_silence()
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused = live_node.call("load")
    assert not refused.success and str(path) in refused.message
    wait_for(live_node, "keyframes", 20)
    path.write_bytes(whole)
    assert live_node.call("load").success
    wait_for(live_node, "keyframes", 10)
    live_node.spin_until(lambda: len(live_node.answers[-1].keyframe_ids) == 10)


@pytest.mark.large
def test_autosave_says_once_that_it_cannot_and_catches_up(live_node, tmp_path) -> None:
    path = tmp_path / "states" / "state.npz"
    path.parent.mkdir()
    patient = "odometry_timeout_s:=1000.0"  # on a busy machine all of this takes a while
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}", "autosave_period_s:=0.2", patient)
    feed(live_node, 0, 10)
    live_node.spin_until(path.exists)
    path.parent.rename(tmp_path / "gone")
    feed(live_node, 10, 20)
    live_node.spin_until(lambda: "cannot write the state file" in live_node.status["message"])
    assert live_node.status["level"] == "1"
    live_node.spin_for(1.0)
    path.parent.mkdir()
    live_node.spin_until(lambda: path.exists() and live_node.status["level"] == "0")
    assert live_node.process.output.count("cannot write the state file") == 1
    feed(live_node, 20, 25)
    wait_for(live_node, "keyframes", 25)
    assert live_node.stop(signal.SIGHUP) == 0  # saves once more, as after SIGINT and SIGTERM
    assert os.listdir(path.parent) == [path.name]
    assert len(np.load(path)["keyframe_id"]) == 25


def test_parameters_change_live_all_or_none(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)

    def set_together(**values: object) -> object:
        parameters = [Parameter(name, value=value).to_parameter_msg() for name, value in values.items()]
        return live_node.call("set_parameters_atomically", SetParametersAtomically, parameters=parameters).result

    assert set_together(keyframe_angle_deg=90.0, keyframe_distance_m=1.0).successful
    feed(live_node, 0, 20)  # turns by 0.2 rad a message: every eighth is a keyframe
    wait_for(live_node, "keyframes", 3)
    refused = set_together(keyframe_angle_deg=0.0, keyframe_distance_m=0.0, method="unheard-of")
    assert not refused.successful and "unheard-of" in refused.reason
    feed(live_node, 20, 24)
    wait_for(live_node, "odometry messages", 24)
    assert live_node.status["keyframes"] == "3"
    for name, value, reason in (
        ("gauge", "identity", "read-only"),
        ("outlier_threshold", 1.5, "outlier_threshold is 1.5; it must be between 0 and 1"),
        ("outlier_threshold", "high", "outlier_threshold is 'high'; it must be a number"),
    ):
        parameter = Parameter(name, value=value).to_parameter_msg()
        (result,) = live_node.call("set_parameters", SetParameters, parameters=[parameter]).results
        assert not result.successful and reason in result.reason
    (descriptor,) = live_node.call("describe_parameters", DescribeParameters, names=["outlier_threshold"]).descriptors
    assert descriptor.description and descriptor.floating_point_range[0].to_value == 1.0


def test_what_came_after_the_last_save_is_told_of_at_the_end(live_node, tmp_path) -> None:
    path = tmp_path / "state.npz"
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}")
    feed(live_node, 0, 10)
    live_node.wait_for_silence()
    assert live_node.call("save").success
    feed(live_node, 10, 12)
    wait_for(live_node, "keyframes", 12)
    assert live_node.stop(signal.SIGTERM) == 0
    told = f"after the last save is lost; 10 keyframes are in {path}; set autosave_period_s to keep all"
    assert told in live_node.process.output


@pytest.mark.large
def test_what_nobody_saved_is_told_of_at_the_end(live_node, tmp_path) -> None:
    path = tmp_path / "states" / "state.npz"
    path.parent.mkdir()

    def feed_and_stop(begin: int, end: int) -> str:
        feed(live_node, begin, end)
        live_node.wait_for_silence()
        assert live_node.stop(signal.SIGTERM) == 0
        return "\n".join(line for line in live_node.process.output.splitlines() if " lost" in line)

    live_node.start(*EVERY_MESSAGE, f"state_file:={path}")
    feed(live_node, 0, 10)
    live_node.wait_for_silence()
    assert live_node.call("save").success
    assert live_node.stop(signal.SIGTERM) == 0
    assert "lost" not in live_node.process.output
    live_node.start(*EVERY_MESSAGE, f"state_file:={path}")
    told = feed_and_stop(10, 12)
    assert f"after the last save is lost; 10 keyframes are in {path}; set autosave_period_s to keep all" in told
    live_node.start(*EVERY_MESSAGE)
    told = feed_and_stop(0, 10)
    assert "10 keyframes are lost that were not saved; set state_file and autosave_period_s to keep all" in told
    live_node.start(*EVERY_MESSAGE, f"state_file:={tmp_path / 'states' / 'new.npz'}", "autosave_period_s:=0.2")
    path.parent.rename(tmp_path / "gone")
    told = feed_and_stop(0, 10)
    assert "10 keyframes are lost that were not saved; make the state file's folder writable to keep all" in told
