"""A view-graph after CleanNet."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Cleaned:
    """A view-graph after CleanNet.

    Attributes:
        graph: the rectified measurements.
        measured: the graph as it was given.
        outlier_probability: ``(M,)`` float32.
        is_inlier: ``(M,)`` bool.
        edges: all of the graph's edges, sorted.
    """

    graph: ViewGraph
    measured: ViewGraph
    outlier_probability: Tensor
    is_inlier: Tensor
    edges: SortedEdges
