"""RTAB-Map's graph, ``rtabmap_msgs/MapGraph``: whole in every message, but optimisation may leave out nodes.

Facts from the package's message definitions and from ``rtabmap/core/Link.h``: a link's transform is the pose of
``to_id`` in the frame of ``from_id``, its matrix is information, not covariance, and nodes carry no stamps. ROS 1
writes the same fields as ``toId``, ``fromId`` and ``posesId``.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rotavg_ros.inputs.fields import edge_id_of, precision_of_information, to_nanoseconds
from rotavg_ros.inputs.foreign_graph import ForeignGraph, edges_in_order
from rotavg_ros.inputs.records import EdgeRecord
from rotavg_ros.online import RejectReason
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.view_graph import EdgeKind

# Link types. 0 joins neighbours in time; 1 … 5 are closures: global, in space, in time, by a user, virtual. 6 stands
# for links through a node that was merged into another. These may include closures, so it may be as wrong as one.
_KIND = {0: EdgeKind.ODOMETRY} | dict.fromkeys(range(1, 7), EdgeKind.LOOP_CLOSURE)
# Pose priors, landmarks and gravity do not join two keyframes.
_NO_EDGES = (7, 8, 9)


class MapGraphConverter(ForeignGraph):
    """The message is about one robot."""

    edges_field = "links"
    sends_parts = False

    def closure_name(self, edge: Any) -> tuple[str, int] | None:
        if _KIND.get(edge.type) != EdgeKind.LOOP_CLOSURE:
            return None
        robot = self._source.robot
        source, target = _ends(edge)
        return robot, edge_id_of((robot, source), (robot, target), EdgeKind.LOOP_CLOSURE)

    def __call__(self, message: Any) -> Iterator[EdgeRecord]:
        robot = self._source.robot
        try:
            stamp_ns = to_nanoseconds(message.header.stamp)
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)
            return
        nodes = _field(message, "poses_id", "posesId")
        if len(nodes):
            # The newest node is the frame that the message was published for.
            self._note_stamp((robot, int(max(nodes))), stamp_ns, is_its_own=False)
        links, unknown = edges_in_order(message.links, _KIND, _NO_EDGES)
        for link in links:
            source, target = _ends(link)
            yield from self._edges(
                ((robot, source), (robot, target)),
                link.transform.rotation,
                link.transform.translation,
                _KIND[link.type],
                precision_of_information(link.information),
            )
        for _ in range(unknown):
            yield EdgeRecord(RejectReason.BAD_KIND)


def _ends(link: Any) -> tuple[int, int]:
    """Ids of a link's source and target."""
    return int(_field(link, "from_id", "fromId")), int(_field(link, "to_id", "toId"))


def _field(message: Any, name: str, in_ros1: str) -> Any:
    return getattr(message, name if hasattr(message, name) else in_ros1)
