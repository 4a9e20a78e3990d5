"""A long message is taken in slices: nothing is lost, nothing overtakes, and a reset drops the rest."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from types import SimpleNamespace

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from std_msgs.msg import Empty

from rotavg_ros.inputs import EdgeRecord
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.ros.node.intake import edge_frames, edge_intake
from rotavg_ros.ros.node.intake.edge_intake import EdgeIntake
from rotavg_ros.ros.node.intake.wiring import Input
from rotavg_ros.ros.node.message_counting import TopicCounter
from rotavg_ros.view_graph import EdgeLabel

LENGTH = 3000
IDENTITY = (0.0, 0.0, 0.0, 1.0)


class Chain:
    """Converts a number into a chain of so many odometry edges."""

    forgotten = 0
    before_each: Callable[[int], object] = staticmethod(lambda index: None)

    def __init__(self) -> None:
        self.given_up: list[tuple[KeyframeReference, ...]] = []

    def __call__(self, message: tuple[str, int]) -> Iterator[EdgeRecord]:
        robot, length = message
        for index in range(length):
            self.before_each(index)
            ends = (KeyframeReference(robot, index), KeyframeReference(robot, index + 1))
            yield EdgeRecord(EdgeMeasurement(index, *ends, IDENTITY, kind=0), robot, index + 1)

    def forget(self) -> None:
        self.forgotten += 1

    def note_given_up(self, *ends: KeyframeReference) -> None:
        self.given_up += [ends]


@pytest.fixture
def executor() -> Iterator[SingleThreadedExecutor]:
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(rclpy.create_node("intake", context=context))
    yield executor
    for node in executor.get_nodes():
        node.destroy_node()
    executor.shutdown()
    rclpy.shutdown(context=context)


def test_a_long_message_lets_others_have_their_turn(executor: SingleThreadedExecutor) -> None:
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    intake = EdgeIntake(executor.get_nodes()[0], online, SimpleNamespace(), lambda reason: None)
    convert, counter = Chain(), TopicCounter()
    intake.add_source(convert)
    topic = Input("/edges", "any", "edge_topics", "", QoSProfile(depth=1))

    def take(robot: str, length: int) -> None:
        intake.take(topic, counter, convert((robot, length)))

    take("long", LENGTH)
    assert 0 < online.counts().edges < LENGTH
    take("short", 1)
    for _ in range(100 * LENGTH):
        if online.counts().edges == LENGTH + 1:
            break
        executor.spin_once(timeout_sec=0.1)
    assert online.snapshot().edge_id.tolist() == [*range(LENGTH), 0]
    assert online.snapshot().robots == ("long", "short") and counter.lost == 0

    take("other", LENGTH)
    online.reset()
    for _ in range(20):
        executor.spin_once(timeout_sec=0.01)
    assert online.counts().edges == 0 and convert.forgotten == 1


@pytest.mark.parametrize("inside", [False, True], ids=["between edges", "at an edge"])
def test_a_graph_that_is_replaced_gets_nothing_of_the_message_before(
    executor: SingleThreadedExecutor, monkeypatch: pytest.MonkeyPatch, inside: bool
) -> None:
    """Another thread may do it between any two edges, and just before the estimator takes one."""
    monkeypatch.setattr(edge_intake, "_SLICE_S", 1000.0)
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    generations: list[int] = []
    forwarding = SimpleNamespace(taken=lambda *those: generations.append(those[-1]))
    intake = EdgeIntake(executor.get_nodes()[0], online, forwarding, lambda reason: None)
    convert, counter = Chain(), TopicCounter()
    intake.add_source(convert)
    topic = Input("/edges", "any", "edge_topics", "", QoSProfile(depth=1), forward=SimpleNamespace())
    add_edge = online.add_edge

    def add(edge: EdgeMeasurement, *of: int) -> object:
        if inside and edge.edge_id == 5:
            online.reset()
        return add_edge(edge, *of)

    monkeypatch.setattr(online, "add_edge", add)
    if not inside:
        convert.before_each = lambda index: index == 5 and online.reset()
    intake.take(topic, counter, convert(("r", 10)))
    assert online.counts().edges == 0 and convert.forgotten == 1
    assert generations == [0] * (6 if inside else 5)
    convert.before_each = lambda index: None
    intake.take(topic, counter, convert(("r", 4)))
    assert online.counts().edges == 4 and convert.forgotten == 1


def test_converters_are_told_what_was_given_up(executor: SingleThreadedExecutor) -> None:
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges", max_edges=2), lambda *_, **__: None)
    intake = EdgeIntake(executor.get_nodes()[0], online, SimpleNamespace(), lambda reason: None)
    convert = Chain()
    intake.add_source(convert)
    topic = Input("/edges", "any", "edge_topics", "", QoSProfile(depth=1))
    intake.take(topic, TopicCounter(), convert(("r", 3)))
    executor.spin_once(timeout_sec=0.1)
    assert online.counts().rejected == {"graph_full": 1} and convert.given_up == []
    for _ in range(2):
        intake.take(topic, TopicCounter(), convert(("r", 0)))
    assert convert.given_up == [(KeyframeReference("r", 2), KeyframeReference("r", 3))]


def test_an_edge_that_waits_for_its_sensors_mounting_can_be_labelled(
    executor: SingleThreadedExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(edge_frames, "_tf_message", lambda: Empty)
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), lambda *_, **__: None)
    intake = EdgeIntake(executor.get_nodes()[0], online, SimpleNamespace(), lambda reason: None, frame_wait_s=1000.0)
    topic = Input("/edges", "any", "edge_topics", "", QoSProfile(depth=1))
    records = [replace(record, frame_id="camera") for record in Chain()(("r", 2))]
    intake.take(topic, TopicCounter(), iter(records))
    assert intake.frames.waiting == 2 and online.counts().edges == 0
    found = [intake.label_edge(robot, edge_id, EdgeLabel.REJECTED) for robot in "rs" for edge_id in (1, 2)]
    assert found == [1, 0, 0, 0]
    for record in records:
        online.add_edge(record.edge)
    assert online.snapshot().graph.label.tolist() == [EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED]
    assert intake.label_edge("r", 1, EdgeLabel.ACCEPTED) == 2
