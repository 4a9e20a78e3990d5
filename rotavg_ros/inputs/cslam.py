"""Swarm-SLAM's keyframes and closures, ``cslam_common_interfaces``: by id, closures without stamp or covariance.

Facts from the package's message definitions and its back end: a closure's ``transform`` is the pose of the second
keyframe in the frame of the first, and counts only with ``success``; robots are numbered, and ``KeyframeOdom`` and
``IntraRobotLoopClosure`` come on a topic of the robot's own without its number.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rotavg_ros.inputs.fields import edge_id_of, target_from_source, to_nanoseconds, to_tuple, to_vector
from rotavg_ros.inputs.foreign_graph import ForeignGraph, Key
from rotavg_ros.inputs.records import EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation
from rotavg_ros.online.quaternion import Quaternion, Vector
from rotavg_ros.view_graph import EdgeKind

_UNKNOWN_PRECISION = 0.0


class KeyframeOdomConverter:
    """A robot's keyframes with their odometry: an odometry edge from each to the next.

    Where messages were lost the edge spans the gap, which it may, because each message carries the whole odometry. An
    id that does not ascend is refused, and the next good one begins a new chain: who counts anew has a new odometry.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._last_id = -1
        self._last: tuple[KeyframeReference, Quaternion, Vector] | None = None

    def forget(self) -> None:
        self._last_id = -1
        self._last = None

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        try:
            edge = self._edge_to(message)
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)
            return
        if edge is not None:
            yield EdgeRecord(edge)

    def _edge_to(self, message: Any) -> EdgeMeasurement | None:
        stamp_ns = to_nanoseconds(message.odom.header.stamp)
        world_from_sensor = checked_rotation(to_tuple(message.odom.pose.pose.orientation))
        keyframe_id, last = int(message.id), self._last
        if keyframe_id <= self._last_id:
            self._last = None
            raise RejectedInputError(RejectReason.OUT_OF_ORDER_ODOMETRY)
        edge_id = edge_id_of(self._last_id, keyframe_id, EdgeKind.ODOMETRY)
        keyframe = KeyframeReference(self._source.robot, keyframe_id, stamp_ns or None)
        position = to_vector(message.odom.pose.pose.position)
        self._last_id, self._last = keyframe_id, (keyframe, world_from_sensor, position)
        if last is None:
            return None
        previous, world_from_previous, previous_position = last
        previous_from_this = quaternion.multiply(quaternion.inverse(world_from_previous), world_from_sensor)
        step = [now - then for now, then in zip(position, previous_position, strict=True)]
        step_from_previous = quaternion.rotate(quaternion.inverse(world_from_previous), step)
        return EdgeMeasurement(
            edge_id,
            previous,
            keyframe,
            target_from_source(previous_from_this, self._source.body_from_sensor),
            EdgeKind.ODOMETRY,
            translation=quaternion.rotate(self._source.body_from_sensor, step_from_previous),
        )


class _LoopClosures(ForeignGraph):
    def _closure(self, ends: tuple[Key, Key], transform: Any) -> Iterator[EdgeRecord]:
        """``transform``: ``geometry_msgs/Transform``."""
        return self._edges(ends, transform.rotation, transform.translation, EdgeKind.LOOP_CLOSURE, _UNKNOWN_PRECISION)


class IntraRobotLoopClosureConverter(_LoopClosures):
    """Closures within a robot."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        if message.success:
            robot = self._source.robot
            ends = (robot, int(message.keyframe0_id)), (robot, int(message.keyframe1_id))
            yield from self._closure(ends, message.transform)


class InterRobotLoopClosureConverter(_LoopClosures):
    """Closures between robots."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        if message.success:
            ends = (
                (self._source.robot_of(int(message.robot0_id)), int(message.robot0_keyframe_id)),
                (self._source.robot_of(int(message.robot1_id)), int(message.robot1_keyframe_id)),
            )
            yield from self._closure(ends, message.transform)
