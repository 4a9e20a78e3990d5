"""Where the baselines start from, and how they take a graph apart into its connected components."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import (
    SpanningForest,
    accumulate_to_root,
    compose_orientations,
    minimum_spanning_forest,
    shortest_path_forest,
)
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Odometry first: no number of steps is worth a closure. A rejected edge is used only where
# nothing else connects.
_CLOSURE_COST = 1e6
_REJECTED_COST = 1e12


def spanning_forest(graph: ViewGraph) -> SpanningForest:
    """The tree that a cold start composes: along odometry where there is any, else breadth-first from the hub."""
    if bool(graph.is_odometry.any()):
        return minimum_spanning_forest(graph, _cost(graph, torch.where(graph.is_odometry, 1.0, _CLOSURE_COST)))
    return shortest_path_forest(graph, _cost(graph, torch.ones(graph.num_edges, dtype=torch.float64)))


def depths(forest: SpanningForest) -> np.ndarray:
    """Edges between each node and its root, ``(N,)``."""
    return accumulate_to_root(forest, np.ones(len(forest.parent)))


def start_orientations(graph: ViewGraph, start: Tensor | None = None) -> tuple[Tensor, np.ndarray]:
    """Orientations ``(N, 4)`` float64 to start from, ``start`` if it is given, and a root for every component."""
    forest = spanning_forest(graph)
    orientations = compose_orientations(forest, graph) if start is None else rotations.normalize(start.double())
    return orientations, forest.roots


def usable_edges(graph: ViewGraph) -> ViewGraph:
    """The graph without its rejected edges, but for those that alone hold a component together."""
    keep = graph.label != EdgeLabel.REJECTED
    if bool(keep.all()):
        return graph
    bridges = spanning_forest(graph).parent_edge
    keep[torch.from_numpy(bridges[bridges >= 0])] = True
    return graph.select_edges(keep)


def solve_by_component(
    graph: ViewGraph, start: Tensor | None, solve_connected: Callable[[ViewGraph, Tensor | None], Tensor]
) -> Tensor:
    """Solve every connected component by itself; a lone node is the identity.

    Args:
        solve_connected: takes a connected graph of two nodes or more, and the start's rows for its nodes.

    Returns:
        ``(N, 4)`` float64.
    """
    body_from_world = rotations.identity(graph.num_nodes)
    component = graph.components()
    for number in torch.nonzero(torch.bincount(component) > 1).flatten().tolist():
        members = torch.nonzero(component == number).flatten()
        if len(members) == graph.num_nodes:
            return solve_connected(graph, start)
        index = torch.full((graph.num_nodes,), -1)
        index[members] = torch.arange(len(members))
        edges = component[graph.source] == number
        chosen = graph.select_edges(edges)
        part = ViewGraph(
            len(members),
            index[chosen.source],
            index[chosen.target],
            chosen.target_from_source,
            chosen.kind,
            chosen.precision,
            chosen.label,
            chosen.steps,
        )
        body_from_world[members] = solve_connected(part, None if start is None else start[members])
    return body_from_world


def _cost(graph: ViewGraph, cost: Tensor) -> Tensor:
    return torch.where(graph.label == EdgeLabel.REJECTED, _REJECTED_COST, cost.double())
