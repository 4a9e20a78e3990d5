"""How far odometry drifts where few closures tell: the mean over all drifts that explain them, not the likeliest.

A hundred closures that span the same stretches are a handful of measurements of how the odometry drifted there. The
likeliest variance of a step can then be a fiftieth of the true one, and an uncertainty stated by it a seventh. So the
errors that closures have in common by passing the same steps are taken for what they are,

    r ~ N(0, σ_o² A + σ_c² F),        A_ij: odometry steps that closures i and j both pass,
                                      F: diagonal, each closure's own variance in units of σ_c²,

and the variance of a step is averaged over its posterior, since that is what the variance of an error averages to.
"""

from __future__ import annotations

import numpy as np

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph

# More closures than this know the drift well enough; and the time grows with their cube.
MAX_CLOSURES = 256
# Known beforehand: a step's standard deviation is about this, give or take this factor.
_STEP_DEG, _STEP_FACTOR = 0.3, 10.0
# Standard deviations that are tried: per step, and of closures in units of the estimate.
_GRID_STEP_DEG = np.geomspace(0.003, 10.0, 36)
_GRID_CLOSURE = np.geomspace(0.3, 3.0, 13)


def expected_step_variance(graph: ClosureGraph, trust: np.ndarray, closure_variance: float, components: int) -> float:
    """Posterior mean of the variance of an odometry step, rad² per component; NaN if closures are none or too many.

    Args:
        trust: ``(E,)`` what each edge weighs beside the others of its kind; closures below ½ take no part.
        closure_variance: rad², as estimated.
    """
    closure = np.flatnonzero(graph.is_closure & (trust > 0.5) & np.isfinite(graph.path_steps))
    if not 0 < len(closure) <= MAX_CLOSURES:
        return float("nan")
    ends = np.stack((graph.position[graph.source[closure]], graph.position[graph.target[closure]]))
    low, high = ends.min(axis=0), ends.max(axis=0)
    shared = np.maximum(np.minimum(high[:, None], high) - np.maximum(low[:, None], low), 0.0)
    forward = np.where(ends[0] < ends[1], 1.0, -1.0)[:, None]
    own_deviation = np.sqrt(graph.own_steps[closure])
    discrepancy = forward * rotations.log(graph.residual[closure]).numpy()[:, 3 - components :]
    discrepancy = discrepancy / own_deviation[:, None]
    variance_of_shared, basis = np.linalg.eigh(shared / np.outer(own_deviation, own_deviation))
    square = ((basis.T @ discrepancy) ** 2).sum(axis=1)

    step = np.radians(_GRID_STEP_DEG) ** 2
    own = closure_variance * _GRID_CLOSURE**2
    variance = step[:, None, None] * np.maximum(variance_of_shared, 0.0) + own[:, None]
    log_likelihood = -0.5 * (components * np.log(variance) + square / variance).sum(axis=2)
    log_prior = -0.5 * (np.log(_GRID_STEP_DEG / _STEP_DEG) / np.log(_STEP_FACTOR)) ** 2
    log_posterior = log_likelihood + log_prior[:, None]
    posterior = np.exp(log_posterior - log_posterior.max()).sum(axis=1)
    return float(posterior @ step / posterior.sum())
