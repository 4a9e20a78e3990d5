"""slam_toolbox's graph, ``slam_toolbox/PoseGraph``, whole in every message, and ``NewNodeEvent``, a node at a time.

Facts from the package's message definitions and its mapper: ``relative_pose`` is the pose of the target's robot in the
frame of the source's, nodes are numbered consecutively as they are created, and an edge's matrix is the covariance
of (x, y, yaw). A graph comes after a loop closure, seconds after its newest node, and its header's stamp is the moment
of publishing, so it gives no node's stamp; the stamps are those of the events. An event has the edge from the node
before; where there is none, as at the first node, both of its ids are 0.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any, NamedTuple

from rotavg_ros.inputs.fields import edge_id_of, to_nanoseconds
from rotavg_ros.inputs.foreign_graph import ForeignGraph
from rotavg_ros.inputs.records import EdgeRecord
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.view_graph import EdgeKind

_UNKNOWN_PRECISION = 0.0
# The variance of the yaw in a row-major 3 × 3 matrix over (x, y, yaw).
_YAW_VARIANCE = 8


class _Position(NamedTuple):
    """As ``geometry_msgs/Point``, metres."""

    x: float
    y: float
    z: float


class _Orientation(NamedTuple):
    """As ``geometry_msgs/Quaternion``."""

    x: float
    y: float
    z: float
    w: float


class _NumberedGraph(ForeignGraph):
    def _numbered(self, edge: Any) -> Iterator[EdgeRecord]:
        """A ``slam_toolbox/GraphEdge``, unless it has been seen."""
        robot, source, target = self._source.robot, int(edge.source_id), int(edge.target_id)
        rotation, position = _parts(edge.relative_pose)
        kind = EdgeKind.ODOMETRY if _is_consecutive(edge) else EdgeKind.LOOP_CLOSURE
        precision = _precision(float(edge.covariance[_YAW_VARIANCE]))
        yield from self._edges(((robot, source), (robot, target)), rotation, position, kind, precision)


class GraphConverter(_NumberedGraph):
    """``PoseGraph``: odometry first, since it creates the keyframes that closures refer to."""

    edges_field = "edges"
    sends_parts = False

    def closure_name(self, edge: Any) -> tuple[str, int] | None:
        if _is_consecutive(edge):
            return None
        robot = self._source.robot
        return robot, edge_id_of((robot, int(edge.source_id)), (robot, int(edge.target_id)), EdgeKind.LOOP_CLOSURE)

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        for edge in sorted(message.edges, key=lambda edge: not _is_consecutive(edge)):
            yield from self._numbered(edge)


class NewNodeConverter(_NumberedGraph):
    """``NewNodeEvent``: the stamp of a node, and the odometry that leads to it."""

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        try:
            self._note_stamp((self._source.robot, int(message.new_node_id)), to_nanoseconds(message.stamp))
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)
        if message.edge.source_id != message.edge.target_id:
            yield from self._numbered(message.edge)


def _is_consecutive(edge: Any) -> bool:
    return abs(int(edge.source_id) - int(edge.target_id)) == 1


def _precision(variance: float) -> float:
    """Rad⁻²."""
    return 1 / variance if variance > 0 else _UNKNOWN_PRECISION


def _parts(relative_pose: Any) -> tuple[Any, Any]:
    """Orientation and position of a ``geometry_msgs/Pose``, or of a ``Pose2D``, which earlier versions use."""
    if not hasattr(relative_pose, "theta"):
        return relative_pose.orientation, relative_pose.position
    half = relative_pose.theta / 2 if math.isfinite(relative_pose.theta) else math.nan
    return _Orientation(0.0, 0.0, math.sin(half), math.cos(half)), _Position(relative_pose.x, relative_pose.y, 0.0)
