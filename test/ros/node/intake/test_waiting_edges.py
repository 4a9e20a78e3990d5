"""Edges that wait for a frame: they are bounded, a reset drops them, and each is handed on once."""

from __future__ import annotations

from collections.abc import Iterator
from types import SimpleNamespace as Fields

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rotavg_ros.inputs import EdgeRecord
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.ros.node.intake import edge_frames
from rotavg_ros.ros.node.intake.edge_frames import EdgeFrames
from rotavg_ros.ros.node.intake.edge_intake import EdgeIntake
from rotavg_ros.ros.node.intake.wiring import Input, Placement
from rotavg_ros.ros.node.message_counting import TopicCounter

QUARTER = (0.0, 0.0, 0.5**0.5, 0.5**0.5)  # about z
FOREVER = 1e6


@pytest.fixture
def node(monkeypatch: pytest.MonkeyPatch) -> Iterator[Node]:
    """A node in a process that has no tf2_msgs: any message type will do, since none comes."""
    monkeypatch.setattr(edge_frames, "_tf_message", lambda: DiagnosticArray)
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("frames", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


def topic() -> Input:
    return Input("/edges", "", "edge_topics", "", QoSProfile(depth=1))


def edge(number: int, robot: str = "a") -> EdgeMeasurement:
    """A quarter turn about x."""
    ends = KeyframeReference(robot, number), KeyframeReference(robot, number + 1)
    return EdgeMeasurement(number, *ends, (0.5**0.5, 0.0, 0.0, 0.5**0.5), kind=0)


def camera_on_base() -> Fields:
    x, y, z, w = QUARTER
    pose = Fields(translation=Fields(x=0.0, y=0.0, z=0.0), rotation=Fields(x=x, y=y, z=z, w=w))
    return Fields(transforms=[Fields(header=Fields(frame_id="base_link"), child_frame_id="camera", transform=pose)])


def spin(node: Node, until) -> None:
    executor = SingleThreadedExecutor(context=node.context)
    executor.add_node(node)
    while not until():
        executor.spin_once(timeout_sec=0.1)
    executor.remove_node(node)


def test_edges_wait_for_the_body_and_for_the_transform(node: Node) -> None:
    taken: list[EdgeMeasurement] = []
    frames, edges = EdgeFrames(node, FOREVER, lambda record, _: taken.append(record.edge)), topic()
    for number in range(3):
        frames.take(EdgeRecord(edge(number), frame_id="camera"), edges)
    frames.take(EdgeRecord(edge(3), frame_id=""), edges)
    assert [each.edge_id for each in taken] == [3] and frames.waiting == 3
    assert edges.placement == {("a", "camera"): Placement.AWAITED}
    frames.note_transforms(camera_on_base())
    frames.note_body("a", "base_link", (0.0, 0.0, 0.0, 1.0))
    spin(node, lambda: frames.waiting == 0)
    assert [each.edge_id for each in taken] == [3, 0, 1, 2]
    x, y, z, w = taken[1].target_from_source  # the camera's x is the body's y
    assert (x, y, z, w) == pytest.approx((0.0, 0.5**0.5, 0.0, 0.5**0.5))
    assert edges.placement == {("a", "camera"): Placement.KNOWN} and edges.sensors == []


def test_what_waits_is_bounded_and_the_first_go_on_as_they_are(node: Node, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(edge_frames, "_MOST_WAITING", 10)
    taken: list[EdgeMeasurement] = []
    frames, edges = EdgeFrames(node, FOREVER, lambda record, _: taken.append(record.edge)), topic()
    edges.note_frames("camera")
    for number in range(11):
        frames.take(EdgeRecord(edge(number), frame_id="camera"), edges)
    assert taken == [edge(0)] and frames.waiting == 10 and edges.sensors == ["camera"]
    frames.take(EdgeRecord(edge(11), frame_id="camera"), edges)  # nobody waits any more for what did not come
    assert taken == [edge(0), edge(11)]


def test_who_has_waited_long_enough_goes_on_as_it_is(node: Node) -> None:
    taken: list[EdgeMeasurement] = []
    frames, edges = EdgeFrames(node, 0.0, lambda record, _: taken.append(record.edge)), topic()
    frames.take(EdgeRecord(edge(0), frame_id="camera"), edges)
    frames.take(EdgeRecord(edge(1, "b"), frame_id="lidar"), edges)
    assert taken == [] and frames.waiting == 2
    spin(node, lambda: frames.waiting == 0)
    assert taken == [edge(0), edge(1, "b")]
    assert set(edges.placement.values()) == {Placement.UNKNOWN}


@pytest.mark.parametrize("wait_s", [None, FOREVER])
def test_without_tf_nothing_waits(node: Node, monkeypatch: pytest.MonkeyPatch, wait_s: float | None) -> None:
    monkeypatch.setattr(edge_frames, "_tf_message", lambda: None)
    taken: list[EdgeMeasurement] = []
    frames, edges = EdgeFrames(node, wait_s, lambda record, _: taken.append(record.edge)), topic()
    edges.note_frames("camera")
    frames.take(EdgeRecord(edge(0), frame_id="camera"), edges)
    assert taken == [edge(0)] and frames.waiting == 0 and edges.sensors == ["camera"]


def test_a_reset_drops_what_waits(node: Node) -> None:
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    refused: list[object] = []
    intake = EdgeIntake(node, estimator, Fields(), refused.append, FOREVER)
    intake.take(topic(), TopicCounter(), iter([EdgeRecord(edge(number), frame_id="camera") for number in range(3)]))
    assert intake.frames.waiting == 3
    estimator.reset()
    intake.frames.note_transforms(camera_on_base())
    intake.frames.note_body("a", "base_link", (0.0, 0.0, 0.0, 1.0))
    spin(node, lambda: intake.frames.waiting == 0)
    assert estimator.counts().edges == 0 and refused == []
    intake.take(topic(), TopicCounter(), iter([EdgeRecord(edge(1), frame_id="camera")]))
    assert estimator.counts().edges == 1
