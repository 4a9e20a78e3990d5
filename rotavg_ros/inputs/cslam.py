"""Swarm-SLAM's keyframes and closures, ``cslam_common_interfaces``: by id, closures without stamp or covariance.

Facts from the package's message definitions and its back end: a closure's ``transform`` is the pose of the second
keyframe in the frame of the first, and counts only with ``success``; robots are numbered, and ``KeyframeOdom`` and
``IntraRobotLoopClosure`` come on a topic of the robot's own without its number.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from rotavg_ros.inputs.fields import Key, edge_id_of, target_from_source, to_nanoseconds, to_tuple, to_vector
from rotavg_ros.inputs.foreign_graph import ForeignGraph
from rotavg_ros.inputs.records import EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation, contradict
from rotavg_ros.online.odometry.continuity import OdometrySample, has_jumped
from rotavg_ros.view_graph import EdgeKind

_UNKNOWN_PRECISION = 0.0


@dataclass(frozen=True)
class _Keyframe:
    reference: KeyframeReference
    odometry: OdometrySample  # of the sensor, not of the body


class KeyframeOdomConverter:
    """A robot's keyframes with their odometry: an odometry edge from each to the next.

    Where messages were lost the edge spans the gap, since each message carries the whole odometry. A new chain, without
    an edge to the last one, begins where the odometry has jumped, and after an id that does not ascend. Such an id is
    refused: a sender that starts counting again has new odometry. So is an edge that contradicts one in the graph.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self.forget()

    def forget(self) -> None:
        self._last_id = -1
        self._last: _Keyframe | None = None
        self._before: OdometrySample | None = None

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        """Do nothing, since odometry is sent only once."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        try:
            edge = self._edge_to(message)
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)
            return
        if edge is not None:
            yield EdgeRecord(edge)

    def _edge_to(self, message: Any) -> EdgeMeasurement | None:
        pose, keyframe_id = message.odom.pose.pose, int(message.id)
        stamp_ns = to_nanoseconds(message.odom.header.stamp)
        sample = OdometrySample(stamp_ns, checked_rotation(to_tuple(pose.orientation)), to_vector(pose.position))
        if keyframe_id <= self._last_id:
            self._last = self._before = None
            raise RejectedInputError(RejectReason.OUT_OF_ORDER_ODOMETRY)
        robot = self._source.robot
        ends = (robot, self._last_id), (robot, keyframe_id)
        last, before = self._last, self._before
        now = _Keyframe(KeyframeReference(robot, keyframe_id, stamp_ns or None), sample)
        self._last_id, self._last, self._before = keyframe_id, now, last.odometry if last else None
        if last is None:
            return None
        if has_jumped(sample, last.odometry, before, self._source.limits()):
            self._before = None
            return None
        edge = self._edge(edge_id_of(*ends, EdgeKind.ODOMETRY), last, now)
        known = self._source.odometry_between(*ends)
        if known is not None and contradict(known, edge.target_from_source):
            raise RejectedInputError(RejectReason.CONTRADICTORY_ODOMETRY)
        return edge

    def _edge(self, edge_id: int, last: _Keyframe, now: _Keyframe) -> EdgeMeasurement:
        last_from_world = quaternion.inverse(last.odometry.world_from_body)
        last_from_now = quaternion.multiply(last_from_world, now.odometry.world_from_body)
        assert now.odometry.position is not None and last.odometry.position is not None
        step = [new - old for new, old in zip(now.odometry.position, last.odometry.position, strict=True)]
        return EdgeMeasurement(
            edge_id,
            last.reference,
            now.reference,
            target_from_source(last_from_now, self._source.body_from_sensor),
            EdgeKind.ODOMETRY,
            translation=quaternion.rotate(self._source.body_from_sensor, quaternion.rotate(last_from_world, step)),
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
