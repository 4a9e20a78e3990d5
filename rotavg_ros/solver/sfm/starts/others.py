"""Starts other than CleanNet, tree and FineNet.

One wrong edge in a tree turns all nodes behind it, and a network that was not trained on such cameras, or such false
edges, leads the refinement into a wrong minimum. So the refinement begins at several starts, and a few steps tell which
is best (``choice.py``). Where cameras have many edges, a subset of them suffices.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.stages import apply_labels, trust_all
from rotavg_ros.solver.neurora.tree import bootstrap
from rotavg_ros.solver.sfm.cycles.evidence import by_triangles
from rotavg_ros.solver.sfm.refinement import PRIORS, coarse_steps
from rotavg_ros.solver.sfm.starts.choice import Start
from rotavg_ros.solver.sfm.starts.spectral import spectral
from rotavg_ros.solver.sfm.step.problem import Problem
from rotavg_ros.solver.sfm.step.structure import Structure
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


def is_sparse(graph: ViewGraph, component: Tensor) -> Tensor:
    """Components in which cameras have few edges on average, ``(C,)`` bool, given the components ``(N,)`` of nodes."""
    nodes = torch.bincount(component)
    edges = torch.bincount(component.index_select(0, graph.source), minlength=len(nodes))
    return 2 * edges < PRIORS.starts.sparse_degree * nodes


def other_starts(judged: Cleaned, is_believed: Tensor, parent_edge: Tensor, component: Tensor) -> list[Start]:
    """A start by eigenvectors, begun at a tree that trusts all edges alike, and more starts for sparse components.

    Args:
        judged: N nodes, M edges with CleanNet's scores and labels, in canonical form.
        is_believed: ``(C,)`` bool, components in which triangles confirm these scores.
        parent_edge: ``(N,)`` a spanning forest.
        component: ``(N,)`` component of every node.
    """
    graph, sparse = judged.measured, is_sparse(judged.measured, component)
    alike = torch.ones(graph.num_edges, dtype=torch.float64, device=graph.device)
    starts: list[Start] = []
    if bool(sparse.any()):
        starts += [Start(orientations, alike, sparse) for orientations in _by_all_alike(graph, component)]
        if bool((sparse & is_believed).any()):
            verdict = by_triangles(judged, component)
            by_triangles_too = bootstrap(verdict, component).body_from_world
            starts.append(Start(by_triangles_too, 1 - verdict.outlier_probability, sparse & is_believed))
    if not bool(sparse.all()):
        chosen = _part(graph, parent_edge)
        part, weight = graph.select_edges(chosen), alike[chosen]
        _, by_eigenvectors = _by_all_alike(part, component)
        problem = Problem(part, Structure.of(part, component), PRIORS)
        settled, _ = coarse_steps(problem, by_eigenvectors, weight)
        starts.append(Start(settled, alike, ~sparse, is_settled=True))
    return starts


def _by_all_alike(graph: ViewGraph, component: Tensor) -> tuple[Tensor, Tensor]:
    """Orientations ``(N, 4)`` by a tree that trusts all edges alike, and by eigenvectors begun at these."""
    verdict = apply_labels(trust_all(graph), graph.label)
    tree = bootstrap(verdict, component).body_from_world
    return tree, spectral(graph, tree, component, 1 - verdict.outlier_probability.double())


def _part(graph: ViewGraph, parent_edge: Tensor) -> Tensor:
    """Indices of edges: at most half of ``sparse_degree`` per source, evenly spread; the forest's; accepted ones."""
    number = torch.arange(graph.num_edges, device=graph.device)
    count = torch.bincount(graph.source, minlength=graph.num_nodes)
    # The rank of an edge among those with its source; a canonical form is sorted by source.
    rank = number - (count.cumsum(0) - count)[graph.source]
    most, of = PRIORS.starts.sparse_degree // 2, count[graph.source]
    is_chosen = (rank + 1) * most // of > rank * most // of
    is_chosen |= (of <= most) | (graph.label == EdgeLabel.ACCEPTED)
    is_chosen[parent_edge[parent_edge >= 0]] = True
    return is_chosen.nonzero()[:, 0]
