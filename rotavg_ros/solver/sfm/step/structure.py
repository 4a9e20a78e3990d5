"""What is known of a graph's connections before any step."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.relaxed_forest import cheapest_forest
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.sfm.series import EdgesInSeries
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


@dataclass(frozen=True)
class Structure:
    """What is known of a graph's connections (N nodes in C components).

    Attributes:
        component: ``(N,)`` connected components.
        roots: ``(C,)`` one node of each component, in the components' order; it is held fixed.
        edges: the graph's edges, sorted.
        series: edges that only check each other.
        accepted: ``(A,)`` edges that the user has accepted.
    """

    component: Tensor
    roots: Tensor
    edges: SortedEdges
    series: EdgesInSeries
    accepted: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, component: Tensor | None = None) -> Structure:
        """Computed from a graph; a component's root is its first node."""
        component = graph.components() if component is None else component
        edges = SortedEdges.of(graph)
        nodes = torch.arange(graph.num_nodes, device=graph.device)
        roots = nodes.new_full((int(component.max()) + 1,), graph.num_nodes)
        roots = roots.scatter_reduce(0, component, nodes, "amin")
        forest = cheapest_forest(graph, edges, torch.ones_like(graph.precision), roots, component)
        series = EdgesInSeries.of(graph, forest.parent, forest.parent_edge)
        return cls(component, roots, edges, series, accepted_edges(graph))

    def redundancy(self, graph: ViewGraph) -> Tensor:
        """Number of edges of each component beyond a spanning tree, ``(C,)``."""
        nodes = torch.bincount(self.component, minlength=len(self.roots))
        if len(self.roots) == 1:
            return graph.num_edges - nodes + 1
        edges = torch.bincount(self.component.index_select(0, graph.source), minlength=len(self.roots))
        return edges - nodes + 1


def accepted_edges(graph: ViewGraph) -> Tensor:
    """Indices ``(A,)`` of the edges that the user has accepted."""
    return (graph.label == EdgeLabel.ACCEPTED).nonzero()[:, 0]
