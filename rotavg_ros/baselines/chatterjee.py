"""Chatterjee & Govindu: robust relative rotation averaging (ICCV 2013, TPAMI 2018), ℓ1 and then ℓ½.

Every step lifts the residuals to the tangent space, where the problem is linear: corrections ω of the nodes whose
differences along the edges explain the residuals. Residuals are world rotations here, ``e_uv = R_v⁻¹ R̃_uv R_u``, so the
three components share one sparse graph Laplacian. The first stage minimises Σ‖r‖ (the paper's L1RA), which forgives a
start that is wrong in places; the second, started there, Σ‖r‖^½, the loss that the paper recommends. Both by
iteratively reweighted least squares with one weight per edge, where the paper's first stage decodes every component of
the residual by linear programming.

On SLAM graphs, residuals count in units of their stated standard deviation. A false closure can hide in a long chain,
which bends a little at every step; ℓ½ sees that only if residuals far below one standard deviation are told apart, and
even then it depends on the start.

Warm start: in place of the spanning tree's orientations; both stages run.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.start import start_orientations, usable_edges
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.view_graph import ViewGraph

# Residuals below this count as this, so that edges that happen to fit exactly do not freeze the solution: in radians,
# and in standard deviations on SLAM graphs.
_SMOOTHING = np.radians(1.0)
_SLAM_SMOOTHING = 0.003


class Stage(NamedTuple):
    """When a stage ends.

    Attributes:
        max_steps: largest number of steps.
        converged_step: rad; or when the mean correction is less.
    """

    max_steps: int
    converged_step: float


# The step that ends the first is the paper's.
_L1_STAGE, _HALF_NORM_STAGE = Stage(30, 1e-3), Stage(100, 1e-4)


def chatterjee(graph: ViewGraph, start: Tensor | None = None) -> Tensor:
    """ℓ1 → ℓ½ orientations, body_from_world ``(N, 4)`` float64; noise-free graphs to rounding.

    Args:
        start: body_from_world ``(N, 4)``; default: composed along a spanning tree.
    """
    graph = usable_edges(graph)
    orientations, roots = start_orientations(graph, start)
    orientations = minimize_l1(graph, orientations, roots)
    return reweighted(graph, orientations, roots, _power_weight(graph, 0.5), _HALF_NORM_STAGE)


def minimize_l1(graph: ViewGraph, body_from_world: Tensor, roots: np.ndarray) -> Tensor:
    """The first stage, Σ‖r‖ over the edges' residual vectors, from ``body_from_world`` ``(N, 4)``."""
    return reweighted(graph, body_from_world, roots, _power_weight(graph, 1.0), _L1_STAGE)


def reweighted(
    graph: ViewGraph,
    body_from_world: Tensor,
    roots: np.ndarray,
    weigh: Callable[[np.ndarray], np.ndarray],
    stage: Stage,
) -> Tensor:
    """Iteratively reweighted least squares on the edges' residual vectors, ``(N, 4)`` float64.

    Args:
        body_from_world: ``(N, 4)`` start.
        roots: a node of each connected component, held fixed.
        weigh: squared residuals ``(M,)`` in rad² → weights ``(M,)``.
    """
    source, target = graph.source.numpy(), graph.target.numpy()
    for _ in range(stage.max_steps):
        residual = edge_residual(body_from_world, graph.target_from_source, graph.source, graph.target)
        vector = rotations.log(residual).numpy()
        weight = weigh((vector**2).sum(axis=1))
        step = LaplacianSystem(graph.num_nodes, source, target, weight, roots).fit(vector)
        body_from_world = rotations.multiply(body_from_world, rotations.exp(torch.from_numpy(step)))
        if float(np.linalg.norm(step, axis=1).mean()) < stage.converged_step:
            break
    return rotations.normalize(body_from_world)


def _power_weight(graph: ViewGraph, power: float) -> Callable[[np.ndarray], np.ndarray]:
    """Weights of the cost Σ‖r‖^power."""
    precision, smoothing = units(graph, _SMOOTHING, _SLAM_SMOOTHING)
    return lambda square: precision * (precision * square + smoothing**2) ** (power / 2 - 1)


def units(graph: ViewGraph, angle: float, deviations: float) -> tuple[np.ndarray, float]:
    """One over the squared unit in which each residual counts, ``(M,)``, and a number in these units.

    Args:
        angle: the number where residuals count in radians.
        deviations: the number where they count in stated standard deviations, as on SLAM graphs.
    """
    stated = graph.precision.isfinite()
    if not bool(graph.is_odometry.any() & stated.any()):
        return np.ones(graph.num_edges), angle
    precision = torch.where(stated, graph.precision, graph.precision[stated].median())
    return precision.numpy(), deviations
