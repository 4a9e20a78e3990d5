"""A view-graph after CleanNet."""

from __future__ import annotations

from dataclasses import dataclass, fields

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Cleaned:
    """A view-graph after CleanNet.

    Attributes:
        graph: the rectified measurements, in the network's single precision, which saves memory with millions of edges.
        measured: the graph as it was given.
        outlier_probability: ``(M,)`` float32.
        edges: all of the graph's edges, sorted.
    """

    graph: ViewGraph
    measured: ViewGraph
    outlier_probability: Tensor
    edges: SortedEdges

    @property
    def is_inlier(self) -> Tensor:
        """``(M,)`` bool."""
        return self.outlier_probability < NUMBERS.outlier_threshold

    def to(self, device: torch.device | str) -> Cleaned:
        """The same on another device."""
        return Cleaned(*(getattr(self, field.name).to(device) for field in fields(self)))
