"""Converts edges in a sensor's frame to the body's by ``/tf_static``; edges that come before it wait a while."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any, NamedTuple

from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy

from rotavg_ros.inputs import EdgeRecord
from rotavg_ros.inputs.sensor_frames import BODY_HAS_NO_NAME, SensorFrames
from rotavg_ros.online import EdgeMeasurement
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.ros.node.intake.wiring import Input, Placement
from rotavg_ros.ros.node.topics import overrides, user_error_about

_TOPIC = "/tf_static"
# Every broadcaster of static transforms latches one message.
_DEPTH = 1000
_MOST_WAITING = 10_000
# How often waiting edges are checked, and how many at a time.
_LOOK_PERIOD_S, _LOOK_AT = 0.1, 1000


class _Waiting(NamedTuple):
    record: EdgeRecord
    topic: Input
    until: float  # on the monotonic clock

    @property
    def edge(self) -> EdgeMeasurement:
        assert isinstance(self.record.edge, EdgeMeasurement)
        return self.record.edge


class EdgeFrames:
    """Passes every edge on, converted to the body's frame if the sensor's mounting is known.

    If the mounting is not known in time, edges are taken as they are, and later ones of that frame no longer wait. A
    transform that comes still later is used from then on. Runs on the executor's thread.
    """

    def __init__(self, node: Node, wait_s: float | None, add: Callable[[EdgeRecord, Input], None]) -> None:
        """Listen to static transforms, if tf2_msgs is installed.

        Args:
            node: the node.
            wait_s: how long an edge waits for a transform, seconds; None: all edges are taken as they are.
            add: takes an edge and the topic that it came on.

        Raises:
            UserError: invalid ``qos_overrides`` of the topic.
        """
        self._node, self._wait_s, self._add = node, wait_s or 0.0, add
        self._sensors = SensorFrames()
        self._waiting: deque[_Waiting] = deque()
        self._timer = node.create_timer(_LOOK_PERIOD_S, self._look, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._timer.cancel()
        message_type = None if wait_s is None else _tf_message()
        self._is_on, self._listens = wait_s is not None, message_type is not None
        if message_type is not None:
            qos = QoSProfile(
                depth=_DEPTH, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL
            )
            with user_error_about(_TOPIC):
                node.create_subscription(
                    message_type, _TOPIC, self.note_transforms, qos, qos_overriding_options=overrides()
                )

    @property
    def waiting(self) -> int:
        """Number of edges that wait."""
        return len(self._waiting)

    def count(self, source_robot: str, edge_id: int) -> int:
        """How many edges with a sender's id wait."""
        return sum(each.edge.edge_id == edge_id and each.edge.source.robot == source_robot for each in self._waiting)

    def note_transforms(self, message: Any) -> None:
        """Remember transforms between frames (:meth:`SensorFrames.take`), and check the edges that waited for them."""
        self._sensors.take(message)
        self._look()

    def note_body(self, robot: str, frame: str, body_from_frame: Quaternion) -> None:
        """Remember the frame whose motion a robot's odometry describes, see :meth:`SensorFrames.note_body`."""
        self._sensors.note_body(robot, frame, body_from_frame)

    def take(self, record: EdgeRecord, topic: Input) -> None:
        """Pass an edge on, now or later."""
        if not self._is_on or not record.frame_id:
            self._add(record, topic)
            return
        waiting = _Waiting(record, topic, time.monotonic() + self._wait_s)
        if self._hand_on(waiting):
            return
        robot = waiting.edge.source.robot
        if not self._listens or topic.placement.get((robot, record.frame_id)) is Placement.UNKNOWN:
            self._add(record, topic)
            return
        topic.note_placement(robot, record.frame_id, Placement.AWAITED)
        self._waiting.append(waiting)
        if len(self._waiting) > _MOST_WAITING:
            self._give_up(self._waiting.popleft())
        if self._timer.is_canceled():  # if reset for each edge, it would never fire while edges flow
            self._timer.reset()

    def forget(self) -> None:
        """Drop the edges that wait."""
        self._waiting.clear()

    def _look(self) -> None:
        now = time.monotonic()
        for _ in range(min(len(self._waiting), _LOOK_AT)):
            if not self._waiting:  # all was forgotten meanwhile
                break
            waiting = self._waiting.popleft()
            if self._hand_on(waiting):
                continue
            if waiting.until <= now:
                self._give_up(waiting)
            else:
                self._waiting.append(waiting)
        if not self._waiting:
            self._timer.cancel()

    def _hand_on(self, waiting: _Waiting) -> bool:
        """Pass an edge on if the mounting of its sensor is known; returns whether it is."""
        edge, frame, topic = waiting.edge, waiting.record.frame_id, waiting.topic
        body_from_sensor = self._sensors.body_from(edge.source.robot, frame)
        if body_from_sensor is None:
            return False
        of_body = body_from_sensor.edge_of_body(edge)
        if of_body != edge and topic.placement.get((edge.source.robot, frame)) is Placement.UNKNOWN:
            self._node.get_logger().warning(
                f"{topic.name}: the transform of {frame} is known now; edges before it were taken as they were: call "
                "~/reset to begin anew without them"
            )
        topic.note_placement(edge.source.robot, frame, Placement.KNOWN)
        unlike = self._sensors.unlike(edge, frame)
        if unlike is not None:
            self._node.get_logger().warning(f"{topic.name}: {unlike}", once=True)
        self._add(replace(waiting.record, edge=of_body), topic)
        return True

    def _give_up(self, waiting: _Waiting) -> None:
        """Pass an edge on as it is."""
        edge, frame, topic = waiting.edge, waiting.record.frame_id, waiting.topic
        if topic.placement.get((edge.source.robot, frame)) is not Placement.UNKNOWN:
            why, remedy = BODY_HAS_NO_NAME, "have it do so"
            if self._sensors.knows_body(edge.source.robot):
                why, remedy = "no transform leads from it to the body's frame", f"publish it on {_TOPIC}"
            self._node.get_logger().warning(
                f"{topic.name}: nothing has said how frame {frame} sits on the body of {edge.source.robot}, so its "
                f"edges are taken as they are: {why}; {remedy}, or set edge_sensor_orientations"
            )
        topic.note_placement(edge.source.robot, frame, Placement.UNKNOWN)
        self._add(waiting.record, topic)


def _tf_message() -> type | None:
    """``tf2_msgs/TFMessage`` if that package is installed, else None."""
    try:
        from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
    except ImportError:
        return None
    message_type: type = TFMessage
    return message_type
