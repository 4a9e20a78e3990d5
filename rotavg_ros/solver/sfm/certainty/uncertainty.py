"""Uncertainty of refined orientations, relative to one node of each component.

It is the least-squares covariance σ² L⁻¹ of the believed edges: each is weighted by the probability that it is no
outlier, and σ² is the sum of the squared residuals of edges with a score below one half over the number of those that
are redundant. Noise is assumed round. Its diagonal
is estimated from random samples of the answer. What a node's own edges contribute is known without any samples, and
where nodes have many edges that is nearly all; there the samples come from conjugate gradients, without a
factorisation.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem, incidence_matrix
from rotavg_ros.solver.sfm.certainty.probes import probe_signs
from rotavg_ros.solver.sfm.laplacians.scalar import ScalarLaplacian
from rotavg_ros.solver.sfm.priors import RefinementPriors, UncertaintyPriors
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

_WELL_KNIT_DEGREE = RefinementPriors().well_knit_degree
PRIORS = UncertaintyPriors()


class References(NamedTuple):
    """What errors are relative to.

    Attributes:
        component: ``(N,)`` of every node.
        node: ``(C,)`` the reference of each.
    """

    component: Tensor
    node: Tensor


class _Samples(NamedTuple):
    """Random node values ``(N, k)`` whose second moments are L⁻¹.

    Spielman & Srivastava (2008): mean squared differences of such values estimate effective resistances, that is
    variances of estimated differences, with a relative error of √(2/k).

    Attributes:
        force: ``(N, k)`` L times the values.
        value: ``(N, k)`` up to a constant in every component.
    """

    force: Tensor
    value: Tensor


def variances(graph: ViewGraph, noise: Tensor, score: Tensor, bridge: Tensor, to: References) -> Tensor | None:
    """Variance ``(N,)`` rad² of each component of a node's error relative to its component's reference.

    NaN in trees, where nothing checks anything, and in well-knit components of graphs with more than a million edges;
    None if there are no others.

    Args:
        noise: ``(C,)`` rad², σ² of each component.
        score: ``(M,)`` probability that an edge is an outlier.
        bridge: ``(B,)`` edges that nothing checks: with the probability of their scores, the part behind them is turned
            by any rotation.
    """
    count = len(to.node)
    size = torch.bincount(to.component, minlength=count)
    # Edges that the user has rejected check nothing.
    edges = torch.bincount(to.component[graph.source[graph.label != EdgeLabel.REJECTED]], minlength=count)
    is_checked, is_loose = edges >= size, 2 * edges < _WELL_KNIT_DEGREE * size
    weight, noise = (1 - score).clamp(min=PRIORS.least_weight), noise[to.component]
    turned = torch.zeros_like(score)
    turned[bridge] = score[bridge] * rotations.RANDOM_VARIANCE
    weight = 1 / (1 / weight + turned / noise[graph.source].clamp(min=PRIORS.least_noise))
    found = weight.new_full((graph.num_nodes,), torch.nan)
    for chosen, sample in ((is_checked & is_loose, _by_factorisation), (is_checked & ~is_loose, _by_iterations)):
        nodes = chosen[to.component]
        edges_of = nodes[graph.source].nonzero().squeeze(1)
        if not len(edges_of):
            continue
        part, of_part = graph.select_edges(edges_of), weight[edges_of]
        samples = sample(part, of_part, to)
        if samples is not None:
            found = torch.where(nodes, noise * _relative(part, of_part, samples, to), found)
    return None if bool(found.isnan().all()) else found


def noise_variance(graph: ViewGraph, angle: Tensor, score: Tensor, component: Tensor) -> Tensor:
    """σ² ``(C,)`` rad² of good edges' errors about each axis: believed edges' squared residuals over their redundancy.

    Others are left out, however small their weight would be: a thousandth of the square of 90° is that of 3°.

    Args:
        angle: ``(M,)`` rad, residuals.
        score: ``(M,)`` probability that an edge is an outlier, given its residual.
    """
    count, is_believed = int(component.max()) + 1, score < PRIORS.flagged
    of_edge, square = component[graph.source[is_believed]], angle[is_believed].to(score).square()
    # Number of believed edges beyond a spanning tree, at least one.
    checks = torch.bincount(of_edge, minlength=count) - torch.bincount(component, minlength=count) + 1
    return square.new_zeros(count).index_add_(0, of_edge, square) / (3 * checks.clamp(min=1))


def _relative(graph: ViewGraph, weight: Tensor, samples: _Samples, to: References) -> Tensor:
    """Variances ``(N,)`` of nodes less their component's reference, in units of σ²; of nodes that have edges.

    With L x = f and D its diagonal, x = f / D + y, where y are the means of the neighbours' x. Since E f xᵀ = 1 up to a
    constant, and E f fᵀ = L, of E (xᵥ − xᵣ)² all is known but E (yᵥ − yᵣ)².
    """
    reference = to.node[to.component]
    degree, beside_reference = weight.new_zeros(2, graph.num_nodes).unbind()
    for one, other in ((graph.source, graph.target), (graph.target, graph.source)):
        degree.index_add_(0, one, weight)
        beside_reference.index_add_(0, one, torch.where(other == reference[other], weight, 0.0))
    of_others = samples.value - samples.force / degree[:, None]
    variance = (of_others - of_others[reference]).square().mean(dim=1)
    variance += 1 / degree + 1 / degree[reference] - 2 * beside_reference / (degree * degree[reference])
    return variance.index_fill(0, to.node, 0.0)


def _by_factorisation(graph: ViewGraph, weight: Tensor, to: References) -> _Samples:
    """Samples for the nodes that have edges, in loosely knit components."""
    is_used = torch.zeros(graph.num_nodes, dtype=torch.bool, device=graph.device)
    is_used[graph.source] = is_used[graph.target] = True
    # Nodes whose variance is not needed are held fixed, like the references.
    fixed = ~is_used
    fixed[to.node] = True
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, weight.cpu().numpy(), fixed.nonzero().squeeze(1).cpu().numpy())
    force = _forces(graph, weight, to)
    return _Samples(force, torch.from_numpy(system.solve(force.cpu().numpy())).to(force))


def _by_iterations(graph: ViewGraph, weight: Tensor, to: References) -> _Samples | None:
    """Samples for the nodes that have edges, in well-knit components; None if the iterations do not converge."""
    if graph.num_edges > PRIORS.most_edges:
        return None
    force = _forces(graph, weight, to)
    value, is_solved = ScalarLaplacian(SortedEdges.of(graph), weight, to.component).solve(force.t().contiguous())
    return _Samples(force, value.t()) if is_solved else None


def _forces(graph: ViewGraph, weight: Tensor, to: References) -> Tensor:
    """Random forces ``(N, k)`` on nodes whose second moments are L: Bᵀ W^½ times random signs."""
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    root = weight.sqrt().cpu().numpy()
    incidence = incidence_matrix(graph.num_nodes, *ends).astype(root.dtype)
    signs = _signs(*ends, to)
    # A few columns at a time: as floating-point numbers, all of them would take much memory.
    parts = [incidence @ (root[:, None] * few) for few in np.array_split(signs, range(8, PRIORS.samples, 8), axis=1)]
    return torch.from_numpy(np.concatenate(parts, axis=1)).to(weight)


def _signs(source: np.ndarray, target: np.ndarray, to: References) -> np.ndarray:
    """Random signs ``(M, k)`` of edges, for each component as if it were alone."""
    component = to.component.cpu().numpy()
    first = np.full(len(to.node), len(component))
    np.minimum.at(first, component, np.arange(len(component)))
    of_edge = component[source]
    signs = np.empty((len(source), PRIORS.samples), dtype=np.int8)
    order = np.argsort(of_edge, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(of_edge[order])) + 1):
        start = first[of_edge[members[0]]]
        signs[members] = probe_signs(source[members] - start, target[members] - start, PRIORS.samples)
    return signs
