"""Uncertainty of refined orientations, relative to one node of each component.

It is the least-squares covariance σ² L⁻¹ of the believed edges: each is weighted by the probability that it is no
outlier, and σ² is the sum of the squared residuals of edges with a score below one half over the number of those that
are redundant among themselves. Noise is assumed round. Its diagonal
is estimated from random samples of the answer. What a node's own edges contribute is known without any samples, and
where nodes have many edges that is nearly all; there the samples come from conjugate gradients, without a
factorisation, and a few tell whether more are needed.
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
from rotavg_ros.view_graph import ViewGraph

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

    NaN in trees, where nothing checks anything, and in well-knit components if these have more than a million edges in
    all, or if iterations do not converge in one of them; None if there are no other components.

    Args:
        noise: ``(C,)`` rad², σ² of each component.
        score: ``(M,)`` probability that an edge is an outlier.
        bridge: ``(B,)`` edges that nothing checks: with the probability of their scores, the part behind them is turned
            by any rotation.
    """
    count = len(to.node)
    size = torch.bincount(to.component, minlength=count)
    edges = torch.bincount(to.component[graph.source], minlength=count)
    is_checked, is_loose = edges >= size, 2 * edges < _WELL_KNIT_DEGREE * size
    weight, noise = (1 - score).clamp(min=PRIORS.least_weight), noise[to.component]
    turned = torch.zeros_like(score)
    turned[bridge] = score[bridge] * rotations.RANDOM_VARIANCE
    weight = 1 / (1 / weight + turned / noise[graph.source].clamp(min=PRIORS.least_noise))
    found = weight.new_full((graph.num_nodes,), torch.nan)
    for chosen, relative in ((is_checked & is_loose, _in_loose), (is_checked & ~is_loose, _in_well_knit)):
        nodes = chosen[to.component]
        edges_of = nodes[graph.source].nonzero().squeeze(1)
        if not len(edges_of):
            continue
        is_whole = len(edges_of) == graph.num_edges
        part = (graph, weight) if is_whole else (graph.select_edges(edges_of), weight[edges_of])
        of_part = relative(*part, to)
        if of_part is not None:
            found = torch.where(nodes, noise * of_part, found)
    return None if bool(found.isnan().all()) else found


def noise_variance(graph: ViewGraph, angle: Tensor, score: Tensor, component: Tensor) -> Tensor:
    """σ² ``(C,)`` rad² of good edges' errors about each axis: believed edges' squared residuals over their redundancy.

    Others are left out, however small their weight would be: a thousandth of the square of 90° is that of 3°.

    Args:
        angle: ``(M,)`` rad, residuals.
        score: ``(M,)`` probability that an edge is an outlier, given its residual.
    """
    count, believed = int(component.max()) + 1, (score < PRIORS.flagged).nonzero()[:, 0]
    ends = [end.index_select(0, believed) for end in (graph.source, graph.target)]
    of_edge, square = component.index_select(0, ends[0]), angle.index_select(0, believed).to(score).square()
    is_joined = torch.zeros_like(component).index_fill_(0, torch.cat(ends), 1)
    # Number of believed edges beyond a tree of the nodes that they join, at least one.
    joined = torch.zeros_like(component[:1]).repeat(count).index_add_(0, component, is_joined)
    checks = torch.bincount(of_edge, minlength=count) - joined + 1
    return square.new_zeros(count).index_add_(0, of_edge, square) / (3 * checks.clamp(min=1))


class _Relative(NamedTuple):
    """Variances of nodes less their component's reference, in units of σ²; of nodes that have edges.

    Attributes:
        variance: ``(N,)``.
        sampled: ``(N,)`` the part of it that samples tell.
    """

    variance: Tensor
    sampled: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, weight: Tensor, samples: _Samples, to: References) -> _Relative:
        """By samples for these edges.

        With L x = f and D its diagonal, x = f / D + y, where y are the means of the neighbours' x. Since E f xᵀ = 1 up
        to a constant, and E f fᵀ = L, of E (xᵥ − xᵣ)² all is known but E (yᵥ − yᵣ)².
        """
        reference = to.node[to.component]
        degree, beside_reference = weight.new_zeros(2, graph.num_nodes).unbind()
        for one, other in ((graph.source, graph.target), (graph.target, graph.source)):
            degree.index_add_(0, one, weight)
            beside_reference.index_add_(0, one, torch.where(other == reference[other], weight, 0.0))
        of_others = samples.value - samples.force / degree[:, None]
        sampled = (of_others - of_others[reference]).square().mean(dim=1)
        variance = sampled + 1 / degree + 1 / degree[reference]
        variance -= 2 * beside_reference / (degree * degree[reference])
        return cls(variance.index_fill(0, to.node, 0.0), sampled.index_fill(0, to.node, 0.0))


def _in_loose(graph: ViewGraph, weight: Tensor, to: References) -> Tensor:
    """Relative variances ``(N,)`` in loosely knit components; of nodes that have edges."""
    is_used = torch.zeros(graph.num_nodes, dtype=torch.bool, device=graph.device)
    is_used[graph.source] = is_used[graph.target] = True
    # Nodes whose variance is not needed are held fixed, like the references.
    fixed = ~is_used
    fixed[to.node] = True
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, weight.cpu().numpy(), fixed.nonzero().squeeze(1).cpu().numpy())
    force = _forces(graph, weight, to, PRIORS.samples)
    samples = _Samples(force, torch.from_numpy(system.solve(force.cpu().numpy())).to(force))
    return _Relative.of(graph, weight, samples, to).variance


def _in_well_knit(graph: ViewGraph, weight: Tensor, to: References) -> Tensor | None:
    """Relative variances ``(N,)`` in well-knit components; of nodes that have edges.

    None if these have more than a million edges in all, or if the iterations do not converge in one of them.
    """
    if graph.num_edges > PRIORS.most_edges:
        return None
    laplacian = ScalarLaplacian(SortedEdges.of(graph), weight, to.component)
    found, is_known = weight.new_zeros(graph.num_nodes), torch.zeros_like(to.node, dtype=torch.bool)
    for count in (PRIORS.first_samples, PRIORS.samples):
        force = _forces(graph, weight, to, count)
        value, is_solved = laplacian.solve(force.t().contiguous())
        if not is_solved:
            return None
        variance, sampled = _Relative.of(graph, weight, _Samples(force, value.t()), to)
        found = torch.where(is_known[to.component], found, variance)
        error = (2 / count) ** 0.5 / 2 * (sampled / variance).nan_to_num(0.0)
        largest = error.new_zeros(len(to.node)).scatter_reduce(0, to.component, error, "amax")
        is_known |= largest <= PRIORS.sample_error
        if bool(is_known.all()):
            break
    return found


def _forces(graph: ViewGraph, weight: Tensor, to: References, count: int) -> Tensor:
    """Random forces ``(N, k)`` on nodes whose second moments are L: Bᵀ W^½ times random signs."""
    ends = graph.source.cpu().numpy(), graph.target.cpu().numpy()
    root = weight.sqrt().cpu().numpy()
    incidence = incidence_matrix(graph.num_nodes, *ends).astype(root.dtype)
    signs = _signs(*ends, to, count)
    # A few columns at a time: as floating-point numbers, all of them would take much memory.
    parts = [incidence @ (root[:, None] * few) for few in np.array_split(signs, range(8, count, 8), axis=1)]
    return torch.from_numpy(np.concatenate(parts, axis=1)).to(weight)


def _signs(source: np.ndarray, target: np.ndarray, to: References, count: int) -> np.ndarray:
    """Random signs ``(M, k)`` of edges, for each component as if it were alone."""
    component = to.component.cpu().numpy()
    first = np.full(len(to.node), len(component))
    np.minimum.at(first, component, np.arange(len(component)))
    of_edge = component[source]
    signs = np.empty((len(source), count), dtype=np.int8)
    order = np.argsort(of_edge, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(of_edge[order])) + 1):
        start = first[of_edge[members[0]]]
        signs[members] = probe_signs(source[members] - start, target[members] - start, count)
    return signs
