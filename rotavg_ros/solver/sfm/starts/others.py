"""Other starts than CleanNet, tree and FineNet.

One wrong edge in a tree turns all that is behind it, and a network that knows nothing of such cameras, or such false
edges, leads the refinement into another valley. So it begins at several places, of which few steps tell the best
(``refinement.py``). Where cameras have many edges, a part of these is enough to tell.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.stages import apply_labels, trust_all
from rotavg_ros.solver.neurora.tree import bootstrap
from rotavg_ros.solver.sfm.cycles.evidence import by_triangles
from rotavg_ros.solver.sfm.refinement import Start, begin
from rotavg_ros.solver.sfm.starts.spectral import spectral
from rotavg_ros.solver.sfm.step import Structure
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Of cameras with fewer edges, in the mean, other starts cost little, and all of their edges are needed to tell.
_SPARSE_DEGREE = 20


def is_sparse(graph: ViewGraph, component: Tensor) -> Tensor:
    """In which components cameras have few edges, in the mean, ``(C,)`` bool; components ``(N,)`` of every node."""
    nodes = torch.bincount(component)
    edges = torch.bincount(component.index_select(0, graph.source), minlength=len(nodes))
    return 2 * edges < _SPARSE_DEGREE * nodes


def other_starts(judged: Cleaned, is_believed: bool, parent_edge: Tensor, component: Tensor) -> list[Start]:
    """By eigenvectors, begun at a tree that trusts all edges alike, and, of sparse components, by more.

    Args:
        judged: N nodes, M edges with CleanNet's word and labels, as they are in canonical form.
        is_believed: whether that word stood.
        parent_edge: ``(N,)`` a spanning forest.
        component: ``(N,)`` of every node.
    """
    graph, sparse = judged.measured, is_sparse(judged.measured, component)
    allowed = (graph.label != EdgeLabel.REJECTED).double()
    starts: list[Start] = []
    if bool(sparse.any()):
        starts += [Start(orientations, allowed, sparse) for orientations in _by_all_alike(graph, component)]
        if is_believed:
            verdict = by_triangles(judged, component)
            by_triangles_too = bootstrap(verdict, component).body_from_world
            starts.append(Start(by_triangles_too, 1 - verdict.outlier_probability, sparse))
    if not bool(sparse.all()):
        chosen = _part(graph, parent_edge)
        part, weight = graph.select_edges(chosen), allowed[chosen]
        _, by_eigenvectors = _by_all_alike(part, component)
        begun = begin(part, [Start(by_eigenvectors, weight)], weight, Structure.of(part, component))
        starts.append(Start(begun.body_from_world, allowed, ~sparse, is_settled=True))
    return starts


def _by_all_alike(graph: ViewGraph, component: Tensor) -> tuple[Tensor, Tensor]:
    """Orientations ``(N, 4)`` by a tree that trusts all edges alike, and by eigenvectors, begun there."""
    verdict = apply_labels(trust_all(graph), graph.label)
    tree = bootstrap(verdict, component).body_from_world
    return tree, spectral(graph, tree, component, 1 - verdict.outlier_probability.double())


def _part(graph: ViewGraph, parent_edge: Tensor) -> Tensor:
    """Indices of edges, evenly spread over those of each camera, half of :data:`_SPARSE_DEGREE` of each at most."""
    number = torch.arange(graph.num_edges, device=graph.device)
    count = torch.bincount(graph.source, minlength=graph.num_nodes)
    # The rank of an edge among those that begin at its source; a canonical form is sorted by these.
    rank = number - (count.cumsum(0) - count)[graph.source]
    most, of = _SPARSE_DEGREE // 2, count[graph.source]
    is_chosen = (rank + 1) * most // of > rank * most // of
    is_chosen |= of <= most
    is_chosen[parent_edge[parent_edge >= 0]] = True
    return is_chosen.nonzero()[:, 0]
