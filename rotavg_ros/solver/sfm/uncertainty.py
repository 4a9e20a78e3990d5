"""Uncertainty of refined orientations, relative to one node of each component.

It is the least-squares covariance σ² L⁻¹ of the believed edges: each is weighted by the probability that it is no
outlier, and σ² is the sum of squared residuals over the number of redundant edges. Its diagonal is estimated from
random samples (:meth:`~rotavg_ros.solver.algebra.sparse.laplacian.FactorisedLaplacian.samples`). Noise is assumed
round. A factorisation takes too long where a graph is well knit.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.probes import probe_signs
from rotavg_ros.view_graph import ViewGraph

_WELL_KNIT_DEGREE = RefinementPriors().well_knit_degree
# Sampled standard deviations err by 9 %.
_SAMPLES = 64
# Weight of edges that are surely wrong, which keeps the graph connected.
_LEAST_WEIGHT = 1e-3
_FLAGGED = 0.5
# Floor of the variance, rad², for graphs without any noise.
_LEAST_NOISE = 1e-12


class References(NamedTuple):
    """What errors are relative to.

    Attributes:
        component: ``(N,)`` of every node.
        node: ``(C,)`` the reference of each.
    """

    component: Tensor
    node: Tensor


def variances(graph: ViewGraph, angle: Tensor, score: Tensor, bridge: Tensor, to: References) -> Tensor | None:
    """Variance ``(N,)`` rad² of each component of a node's error relative to its component's reference.

    NaN in components that are well knit, and in trees, where nothing checks anything; None if there are no others.

    Args:
        angle: ``(M,)`` rad, residuals.
        score: ``(M,)`` probability that an edge is an outlier.
        bridge: ``(B,)`` edges that nothing checks: with the probability of their scores, the part behind them is turned
            by any rotation.
    """
    count = len(to.node)
    size = torch.bincount(to.component, minlength=count)
    edges = torch.bincount(to.component[graph.source], minlength=count)
    is_loose = (2 * edges < _WELL_KNIT_DEGREE * size) & (edges >= size)
    if not bool(is_loose.any()):
        return None
    loose = is_loose[to.component]
    kept = loose[graph.source].nonzero().squeeze(1)
    weight = (1 - score[kept]).clamp(min=_LEAST_WEIGHT)
    source, target = graph.source[kept], graph.target[kept]

    def sums(value: Tensor) -> Tensor:
        return value.new_zeros(count).index_add_(0, to.component[source], value)

    # Number of believed edges beyond a spanning tree, at least one.
    checks = (sums((score[kept] < _FLAGGED).to(weight)) - size + 1).clamp(min=1)
    noise = sums(weight * angle[kept].to(weight).square()) / (3 * checks)
    turned = torch.zeros_like(score)
    turned[bridge] = score[bridge] * rotations.RANDOM_VARIANCE
    turned = turned[kept] / noise[to.component[source]].clamp(min=_LEAST_NOISE)
    weight = 1 / (1 / weight + turned)
    # Nodes whose variance is not needed are held fixed, like the references.
    fixed = ~loose
    fixed[to.node] = True
    ends = source.cpu().numpy(), target.cpu().numpy()
    system = LaplacianSystem(graph.num_nodes, *ends, weight.cpu().numpy(), fixed.nonzero().squeeze(1).cpu().numpy())
    signs = _signs(*ends, to.component[source].cpu().numpy(), _first_nodes(to.component, count))
    samples = torch.from_numpy(system.samples(signs)).to(weight)
    difference = samples - samples[to.node][to.component]
    return torch.where(loose, noise[to.component] * difference.square().mean(dim=1), torch.nan)


def _first_nodes(component: Tensor, count: int) -> np.ndarray:
    """``(C,)`` of every component."""
    nodes = torch.arange(len(component), device=component.device)
    first = nodes.new_full((count,), len(component)).scatter_reduce(0, component, nodes, "amin")
    return np.asarray(first.cpu().numpy())


def _signs(source: np.ndarray, target: np.ndarray, component: np.ndarray, first: np.ndarray) -> np.ndarray:
    """Random signs ``(M, samples)`` of edges, for each component as if it were alone."""
    signs = np.empty((len(source), _SAMPLES), dtype=np.int8)
    order = np.argsort(component, kind="stable")
    for members in np.split(order, np.flatnonzero(np.diff(component[order])) + 1):
        start = first[component[members[0]]]
        signs[members] = probe_signs(source[members] - start, target[members] - start, _SAMPLES)
    return signs
