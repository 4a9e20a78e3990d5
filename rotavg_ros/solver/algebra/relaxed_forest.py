"""Shortest-path forests by rounds over all edges (Bellman 1958), for accelerators; a CPU uses Dijkstra's algorithm.

A round costs one pass over the edges, and there are as many rounds as the deepest path has edges: three or four on the
view-graphs that are dense enough for an accelerator.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.spanning_forest import shortest_path_forest
from rotavg_ros.view_graph import ViewGraph


class RelaxedForest(NamedTuple):
    """As :class:`~rotavg_ros.solver.algebra.spanning_forest.SpanningForest`, in tensors: N nodes, C roots."""

    parent: Tensor
    parent_edge: Tensor
    roots: Tensor


def hubs(edges: SortedEdges, component: Tensor) -> Tensor:
    """The node of highest degree in each component ``(C,)`` int64; of several, the first."""
    count = int(component.max()) + 1
    degree = edges.degree.long()
    highest = degree.new_zeros(count).scatter_reduce(0, component, degree, "amax")
    node = torch.arange(edges.num_nodes, device=component.device)
    candidate = torch.where(degree == highest[component], node, edges.num_nodes)
    return node.new_full((count,), edges.num_nodes).scatter_reduce(0, component, candidate, "amin")


def cheapest_forest(
    graph: ViewGraph, edges: SortedEdges, cost: Tensor, roots: Tensor, component: Tensor
) -> RelaxedForest:
    """Paths of least total cost: by Dijkstra's algorithm on a CPU, by rounds over all edges elsewhere.

    Args:
        edges: those of the graph, sorted.
        cost: ``(M,)``, positive.
        roots: ``(C,)`` one node of each component, in the components' order.
        component: ``(N,)`` component of every node.
    """
    if graph.device.type != "cpu":
        return relaxed_forest(edges, cost, roots)
    forest = shortest_path_forest(graph, cost, roots, edges=edges, component=component)
    return RelaxedForest(torch.from_numpy(forest.parent), torch.from_numpy(forest.parent_edge), roots)


def relaxed_forest(edges: SortedEdges, cost: Tensor, roots: Tensor) -> RelaxedForest:
    """Paths of least total ``cost`` ``(M,)``, positive, from the nearest of the ``roots`` ``(C,)``."""
    source, target = edges.source.long(), edges.target().long()
    step = cost.double()[edges.edge.long()]
    distance = step.new_full((edges.num_nodes,), torch.inf)
    distance[roots] = 0
    while True:
        arriving = distance[source] + step
        shorter = distance.scatter_reduce(0, target, arriving, "amin")
        if torch.equal(shorter, distance):
            break
        distance = shorter
    # The first edge that attains the distance. Costs are positive, so parents are nearer and there is no cycle.
    rows = len(step)
    row = torch.where(arriving == distance[target], torch.arange(rows, device=step.device), rows)
    first = row.new_full((edges.num_nodes,), rows).scatter_reduce(0, target, row, "amin")
    first[roots] = rows
    child = (first < rows).nonzero().squeeze(1)
    parent = torch.arange(edges.num_nodes, device=step.device)
    parent_edge = torch.full_like(parent, -1)
    parent[child] = source[first[child]]
    parent_edge[child] = edges.edge.long()[first[child]]
    return RelaxedForest(parent, parent_edge, roots)
