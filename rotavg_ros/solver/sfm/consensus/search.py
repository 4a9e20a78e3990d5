"""Looks for another answer where edges that the first one rejects agree with each other.

Robust costs settle for what most edges near the start roughly agree on. False edges may agree roughly, as failed
registrations of scans do near the identity, but good ones agree exactly: their triangles close. So other answers begin
at trees of the edges with most closing triangles. The answer under which the edges are likeliest is chosen.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import EdgeResiduals, angles_after_alignment
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, minimum_spanning_forest
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.consensus.density import Edges, Fitted, fitted
from rotavg_ros.solver.sfm.cycles.triangles import Triangles
from rotavg_ros.solver.sfm.priors import ConsensusPriors
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

CONSENSUS = ConsensusPriors()
# Edges without a closing triangle are used last.
_NO_VOTE = 1e-6
_OTHER = (
    "some edges contradict others but agree among themselves, so there are two answers; {apart} of {all} orientations "
    "differ between them by more than 20°, and the likelier answer was taken: false edges that agree can be likelier "
    "than good ones, so check whether these views fit"
)
_TOO_LARGE = (
    "some edges contradict the answer but agree among themselves, so there may be another answer; the graph is too "
    "large to search for it: check whether the views fit, or solve a part of them"
)


class Consensus(NamedTuple):
    """Result of the search on a graph of N nodes and M edges.

    Attributes:
        body_from_world: ``(N, 4)``, with another answer in some components; None if none is likelier.
        weight: ``(M,)`` probability that an edge is good; 1 in all other components. None if no answer is likelier.
        warnings: a sentence where another answer was found, or could not be looked for.
    """

    body_from_world: Tensor | None
    weight: Tensor | None
    warnings: tuple[str, ...]


def consensus(
    graph: ViewGraph,
    body_from_world: Tensor,
    component: Tensor,
    priors: ConsensusPriors,
    angle: Tensor | None = None,
) -> Consensus | None:
    """Another answer in those components where one is likelier; None if edges contradict the first one nowhere.

    Args:
        graph: N nodes, M edges, which run from lower to higher nodes.
        body_from_world: ``(N, 4)`` the first answer.
        component: ``(N,)`` component of every node.
        angle: ``(M,)`` rad, residuals of the first answer; default: computed.
    """
    angle = EdgeResiduals(graph, body_from_world.float()).angles() if angle is None else angle
    is_off, count = angle > NUMBERS.outlier_angle, int(component.max()) + 1
    most = torch.full((count,), priors.glance, device=component.device)
    contradicting = Triangles.of(graph, most, is_off, component).contradicting(
        is_off, component.index_select(0, graph.source), count, priors.closing[0]
    )
    numbers = (contradicting > priors.contradicting).nonzero()[:, 0].tolist()
    if not numbers:
        return None
    device, graph, of_node = graph.device, graph.to("cpu"), component.cpu()
    answer, weight = body_from_world.double().cpu().clone(), torch.ones(graph.num_edges, dtype=torch.float64)
    of_edge, num_apart, is_other, is_too_large = of_node[graph.source], 0, False, False
    for number in numbers:
        node, edge = ((of == number).nonzero()[:, 0] for of in (of_node, of_edge))
        if len(node) > priors.max_nodes or len(edge) > priors.max_edges:
            is_too_large = True
            continue
        found = _searched(_edges(graph, node, edge), answer[node], priors)
        if found is not None:
            other = torch.from_numpy(np.ascontiguousarray(found.body_from_world.T))
            num_apart += _num_apart(answer[node], other)
            answer[node], weight[edge] = other, torch.from_numpy(found.good)
            is_other = True
    warnings = (_OTHER.format(apart=num_apart, all=graph.num_nodes),) if num_apart else ()
    warnings = (*warnings, _TOO_LARGE) if is_too_large else warnings
    if not is_other:
        return Consensus(None, None, warnings)
    return Consensus(answer.to(device), weight.to(device), warnings)


def _edges(graph: ViewGraph, node: Tensor, edge: Tensor) -> Edges:
    """The edges ``edge`` ``(m,)`` of a graph, all among the nodes ``node`` ``(n,)``, which are renumbered."""
    number = torch.empty(graph.num_nodes, dtype=torch.int64)
    number[node] = torch.arange(len(node))
    source, target = (number[end[edge]].numpy() for end in (graph.source, graph.target))
    measured = np.ascontiguousarray(graph.target_from_source[edge].double().numpy().T)
    is_trusted = graph.label[edge] == EdgeLabel.ACCEPTED
    return Edges(len(node), source, target, measured, is_trusted.numpy())


def _searched(edges: Edges, answer: Tensor, priors: ConsensusPriors) -> Fitted | None:
    """The likeliest answer if it is not the first one, ``answer`` ``(n, 4)``."""
    graph = ViewGraph.create(edges.source, edges.target, edges.measured.T, num_nodes=edges.num_nodes)
    triangles = Triangles.of(graph, priors.max_triangles)
    first = fitted(edges, np.ascontiguousarray(answer.numpy().T), priors)
    is_trusted = torch.from_numpy(edges.is_trusted)
    votes = (triangles.votes(closing, graph.num_edges) for closing in priors.closing)
    others = [fitted(edges, _along_tree(graph, of.masked_fill(is_trusted, torch.inf)), priors) for of in votes]
    best = max(others, key=lambda other: other.log_likelihood)
    return best if best.log_likelihood > first.log_likelihood + priors.ahead else None


def _along_tree(graph: ViewGraph, votes: Tensor) -> np.ndarray:
    """Orientations ``(4, n)`` along the tree of the edges with most ``votes`` ``(m,)``, which may be infinite."""
    forest = minimum_spanning_forest(graph, 1 / (_NO_VOTE + votes))
    return np.ascontiguousarray(compose_orientations(forest, graph).numpy().T)


def _num_apart(one: Tensor, other: Tensor) -> int:
    """Number of orientations that are far apart in two answers, each ``(n, 4)`` in its own gauge."""
    together = torch.zeros(len(one), dtype=torch.int64)
    return int((angles_after_alignment(one, other, together, 1) > NUMBERS.outlier_angle).sum())
