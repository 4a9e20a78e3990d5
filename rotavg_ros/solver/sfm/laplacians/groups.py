"""Components of a graph whose systems are solved together: in the same precision, by the same preconditioner."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import measured_rows
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.sfm.laplacians.block import Arrivals
from rotavg_ros.view_graph import ViewGraph


class Way(NamedTuple):
    """How systems are solved: in single or double precision, and by blocks on the diagonal or a factorisation."""

    is_single: bool
    is_factorised: bool

    @property
    def dtype(self) -> torch.dtype:
        return torch.float32 if self.is_single else torch.float64

    def chosen(self, is_well_knit: np.ndarray, is_single: np.ndarray) -> np.ndarray:
        """Components ``(C,)`` that are solved in this way."""
        if self.is_factorised:
            return np.asarray(~is_well_knit)
        return np.asarray(is_well_knit & (is_single if self.is_single else ~is_single))


# Along a ring of thousands of cameras rounding to single precision exceeds what is to be solved for, so what is
# factorised is in double precision.
WAYS = (
    Way(is_single=True, is_factorised=False),
    Way(is_single=False, is_factorised=False),
    Way(is_single=False, is_factorised=True),
)


@dataclass(frozen=True)
class Group:
    """Some of the components of a graph of N nodes and M edges.

    Attributes:
        graph: all N nodes, but only the K edges of these components.
        edge: ``(K,)`` which of the M edges these are; None: all of them.
        arrivals: of the K edges.
        fixed: nodes that a factorisation holds fixed: one of each component, and all that are in no component of these.
    """

    graph: ViewGraph
    edge: Tensor | None
    arrivals: Arrivals
    fixed: Tensor

    @classmethod
    def some(cls, graph: ViewGraph, roots: Tensor, is_node: Tensor) -> Group:
        """The components whose nodes ``is_node`` ``(N,)`` marks, with the ``roots`` ``(C,)`` of all."""
        edge = is_node.index_select(0, graph.source).nonzero().squeeze(1)
        own, is_fixed = graph.select_edges(edge), ~is_node
        is_fixed[roots] = True
        return cls(own, edge, Arrivals(SortedEdges.of(own)), is_fixed.nonzero().squeeze(1))

    @cached_property
    def measured(self) -> Tensor:
        """``(4, K)`` float32, the measurements."""
        return measured_rows(self.graph.target_from_source, torch.float32)

    def of(self, value: Tensor) -> Tensor:
        """Of the edges' values ``(…, M)`` those of the group, ``(…, K)``."""
        return value if self.edge is None else value[..., self.edge]

    def among_all(self, value: Tensor, num_edges: int) -> Tensor:
        """The group's values ``(K,)`` in their places among all ``(M,)`` edges, in double precision; zero elsewhere."""
        if self.edge is None:
            return value
        return value.new_zeros(num_edges, dtype=torch.float64).index_copy_(0, self.edge, value.double())
