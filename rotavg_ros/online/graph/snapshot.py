"""An edge on its way into the graph, and the graph at one moment."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.compaction.marginalized_keyframes import MarginalizedIndex
from rotavg_ros.online.measurements import OWN_EDGE_ID
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


@dataclass(frozen=True, slots=True)
class GraphEdge:
    """An edge between two nodes.

    Attributes:
        source, target: nodes.
        target_from_source: xyzw, of unit length.
        kind, label: :class:`EdgeKind` and :class:`EdgeLabel` values.
        edge_id: the sender's; default: the id of edges that the estimator itself makes.
        precision: rad⁻², NaN unknown.
        translation: of the target in the source's frame, metres; NaN unknown.
        steps: number of odometry steps that it stands for.
        route: row in the graph's routes; -1: none.
    """

    source: int
    target: int
    target_from_source: Quaternion
    kind: int
    label: int = EdgeLabel.AUTOMATIC
    edge_id: int = OWN_EDGE_ID
    precision: float = math.nan
    translation: Vector = UNKNOWN_VECTOR
    steps: float = 1.0
    route: int = -1


@dataclass(frozen=True)
class GraphSnapshot:
    """The graph at one moment, sharing memory with the growing one (N keyframes, M edges).

    Attributes:
        graph: what the solver gets.
        robots: names.
        keyframe_robot: ``(N,)`` int32 index into ``robots``.
        keyframe_id: ``(N,)`` uint64.
        stamp_ns: ``(N,)`` int64, -1 where unknown.
        time_line: ``(N,)`` int64, which of its robot's time lines the stamp belongs to, from 0.
        edge_id: ``(M,)`` uint64, the senders' ids.
        translation: ``(M, 3)`` position of the edge's target in its source's frame, metres; NaN unknown.
        marginalized: keyframes that were marginalised and now lie on edges.
        revision: of the growing graph.
    """

    graph: ViewGraph
    robots: tuple[str, ...]
    keyframe_robot: NDArray[np.int32]
    keyframe_id: NDArray[np.uint64]
    stamp_ns: NDArray[np.int64]
    time_line: NDArray[np.int64]
    edge_id: NDArray[np.uint64]
    translation: NDArray[np.float64]
    marginalized: MarginalizedIndex
    revision: int

    def keyframe_name(self, row: int) -> str:
        """A keyframe's id as its sender knows it, after its robot's name where there are several."""
        number = str(int(self.keyframe_id[row]))
        return number if len(self.robots) == 1 else f"{self.robots[int(self.keyframe_robot[row])]} {number}"
