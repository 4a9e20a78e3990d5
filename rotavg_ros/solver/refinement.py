"""Robust Gauss–Newton refinement of an SfM view-graph: ℓ½ iteratively reweighted least squares on the tangent space.

After Chatterjee & Govindu (2018), started from a good initialisation and weighted by CleanNet's scores. The residual of
an edge is a rotation of the world frame, so its three components share one Laplacian (see ``laplacian.py``).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.fine_net import edge_residual
from rotavg_ros.solver.laplacian import LaplacianSystem
from rotavg_ros.view_graph import ViewGraph

DEFAULT_STEPS = 3
# |r|^(−3/2) is the weight of ρ = |r|^½; residuals below this angle count as this.
_SMOOTHING = np.radians(0.5)
_CONVERGED_STEP = np.radians(0.001)


def refine(
    graph: ViewGraph, body_from_world: Tensor, prior_weight: Tensor | None, roots: np.ndarray, num_steps: int
) -> Tensor:
    """At most ``num_steps`` reweighted least-squares steps.

    Args:
        body_from_world: ``(N, 4)`` start.
        prior_weight: ``(M,)`` in [0, 1], multiplied to every robust weight; default 1.
        roots: a node of each connected component, held fixed.

    Returns:
        ``(N, 4)`` orientations.
    """
    source, target = graph.source.numpy(), graph.target.numpy()
    prior = np.ones(graph.num_edges) if prior_weight is None else prior_weight.double().numpy()
    orientations = body_from_world.double()
    residual = _residual_vectors(graph, orientations)
    for _ in range(num_steps):
        square = (residual**2).sum(axis=1)
        weight = np.maximum(prior, 1e-6) * (square + _SMOOTHING**2) ** -0.75
        step = LaplacianSystem(graph.num_nodes, source, target, weight, roots).fit(residual)
        orientations = rotations.multiply(orientations, rotations.exp(torch.from_numpy(step)))
        residual = _residual_vectors(graph, orientations)
        if np.abs(step).max(initial=0.0) < _CONVERGED_STEP:
            break
    return rotations.normalize(orientations)


def _residual_vectors(graph: ViewGraph, body_from_world: Tensor) -> np.ndarray:
    residual = edge_residual(body_from_world, graph.target_from_source, graph.source, graph.target)
    return rotations.log(residual).numpy()
