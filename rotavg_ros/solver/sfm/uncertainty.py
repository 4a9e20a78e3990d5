"""How far refined orientations may be off, relative to one node of each component.

The least-squares covariance σ² L⁻¹ of the edges that are believed: each counts by the probability that it is no
outlier, and σ² is what residuals say of the noise, divided by the edges that check others. Random samples of that
covariance tell its diagonal (:meth:`~rotavg_ros.solver.algebra.laplacian.FactorisedLaplacian.samples`). Noise is taken
to be round. A factorisation takes too long where a graph is well knit.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.laplacian import LaplacianSystem
from rotavg_ros.solver.algebra.probes import probe_signs
from rotavg_ros.view_graph import ViewGraph

# Sampled standard deviations err by 9 %.
_SAMPLES = 64
# Of edges that are surely wrong: they hold the graph together.
_LEAST_WEIGHT = 1e-3
_FLAGGED = 0.5


class References(NamedTuple):
    """What errors are relative to.

    Attributes:
        component: ``(N,)`` of every node.
        node: ``(C,)`` the reference of each.
    """

    component: Tensor
    node: Tensor


def variances(graph: ViewGraph, angle: Tensor, score: Tensor, to: References) -> Tensor:
    """Variance ``(N,)`` rad² of each component of a node's error relative to its component's reference.

    Args:
        angle: ``(M,)`` rad, residuals.
        score: ``(M,)`` probability that an edge is an outlier.
    """
    weight = (1 - score).clamp(min=_LEAST_WEIGHT)
    of_edge, count = to.component[graph.source], len(to.node)

    def sums(value: Tensor) -> Tensor:
        return value.new_zeros(count).index_add_(0, of_edge, value)

    # Edges beyond a spanning tree, at least one: a tree alone says nothing of its noise.
    believed = sums((score < _FLAGGED).to(weight))
    checks = (believed - torch.bincount(to.component, minlength=count) + 1).clamp(min=1)
    noise = sums(weight * angle.to(weight).square()) / (3 * checks)
    ends = (end.cpu().numpy() for end in (graph.source, graph.target))
    source, target = ends
    system = LaplacianSystem(graph.num_nodes, source, target, weight.cpu().numpy(), to.node.cpu().numpy())
    samples = torch.from_numpy(system.samples(probe_signs(source, target, _SAMPLES))).to(weight)
    difference = samples - samples[to.node][to.component]
    return noise[to.component] * difference.square().mean(dim=1)
