"""Kimera's graphs, ``pose_graph_tools_msgs/PoseGraph``: whole or in parts, of one robot or of several.

Facts from the package's message definitions: ``pose`` is the pose of ``key_to`` in the frame of ``key_from`` with its
covariance, robots are numbered, nodes carry stamps.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rotavg_ros.inputs.fields import Key, edge_id_of, precision_of_covariance, to_nanoseconds
from rotavg_ros.inputs.foreign_graph import ForeignGraph, edges_in_order, ends_of
from rotavg_ros.inputs.records import EdgeRecord, EdgeVerdict, Source
from rotavg_ros.online import KeyframeReference, RejectReason
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

# PoseGraphEdge.type
_ODOMETRY, _CLOSURE, _REJECTED_CLOSURE = 0, 1, 3
_KIND = {
    _ODOMETRY: EdgeKind.ODOMETRY,
    _CLOSURE: EdgeKind.LOOP_CLOSURE,
    _REJECTED_CLOSURE: EdgeKind.LOOP_CLOSURE,
}
# Landmarks and the edges of a mesh do not join two keyframes.
_NO_EDGES = (2, 4, 5, 6)


class PoseGraphConverter(ForeignGraph):
    """The sender's verdict on a closure counts until the sender withdraws it."""

    edges_field = "edges"
    sends_parts = True

    def __init__(self, source: Source) -> None:
        super().__init__(source)
        self._rejected: set[tuple[Key, Key]] = set()

    def forget(self) -> None:
        super().forget()
        self._rejected.clear()

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        super().note_given_up(source, target)
        self._rejected.discard(ends_of(source, target))  # when it is sent again, so is the verdict

    def __call__(self, message: Any) -> Iterator[EdgeRecord | EdgeVerdict]:
        for node in message.nodes:
            try:
                self._note_stamp(self._key(node.robot_id, node.key), to_nanoseconds(node.header.stamp))
            except RejectedInputError as rejection:
                yield EdgeRecord(rejection.reason)
        edges, unknown = edges_in_order(message.edges, _KIND, _NO_EDGES)
        for edge in edges:
            yield from self._new(edge)
        for _ in range(unknown):
            yield EdgeRecord(RejectReason.BAD_KIND)

    def _new(self, edge: Any) -> Iterator[EdgeRecord | EdgeVerdict]:
        if edge.robot_from < 0 or edge.robot_to < 0:
            yield EdgeRecord(RejectReason.BAD_REFERENCE)
            return
        ends = self._ends(edge)
        kind, precision = _KIND[edge.type], precision_of_covariance(edge.covariance)
        yield from self._edges(ends, edge.pose.orientation, edge.pose.position, kind, precision)
        is_rejected = edge.type == _REJECTED_CLOSURE
        if kind == EdgeKind.LOOP_CLOSURE and is_rejected != (ends in self._rejected):
            (self._rejected.add if is_rejected else self._rejected.discard)(ends)
            label = EdgeLabel.REJECTED if is_rejected else EdgeLabel.AUTOMATIC
            yield EdgeVerdict(ends[0][0], edge_id_of(*ends, kind), label)

    def closure_name(self, edge: Any) -> tuple[str, int] | None:
        if _KIND.get(edge.type) != EdgeKind.LOOP_CLOSURE:
            return None
        source, target = self._ends(edge)
        return source[0], edge_id_of(source, target, EdgeKind.LOOP_CLOSURE)

    def _ends(self, edge: Any) -> tuple[Key, Key]:
        return self._key(edge.robot_from, edge.key_from), self._key(edge.robot_to, edge.key_to)

    def _key(self, robot: int, key: int) -> Key:
        return (self._source.robot_of(int(robot)), int(key))
