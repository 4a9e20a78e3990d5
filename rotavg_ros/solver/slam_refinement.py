"""Robust refinement of a SLAM graph: Gauss–Newton on the closure graph, every closure judged by all the others.

One pass solves one sparse system. It gives the corrections, and from a few more right-hand sides the effective
resistance of every edge, that is the variance of the difference of its ends. With it each edge is judged by what
the rest of the graph predicts of it (leave-one-out), which a long chain with one closure on it forgives and a dense
neighbourhood does not, and both noise variances are re-estimated by their redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.fine_net import edge_residual
from rotavg_ros.solver.laplacian import LaplacianSystem, probe_signs
from rotavg_ros.solver.noise_model import NoiseModel, outlier_share

MAX_PASSES = 20
_NUM_PROBES = 48
_CONVERGED_STEP = np.radians(0.002)
_CONVERGED_PROBABILITY = 2e-3
# An edge that alone holds two parts of the graph together has leverage 1; it cannot be judged by the others.
_MAX_LEVERAGE = 0.999
# Redundancy below this many edges' worth says little about a variance; the estimate so far is worth as much.
_PRIOR_ODOMETRY_REDUNDANCY = 5.0
_PRIOR_CLOSURE_SQUARE = np.radians(0.08) ** 2
# Neighbouring closures of a real front end err together, which in the fit looks like odometry noise. How odometry
# drifts over long ways tells otherwise, so the fit may not raise that estimate beyond this factor.
_MAX_STEP_VARIANCE_GAIN = 2.0


@dataclass(frozen=True)
class SlamEstimate:
    """The refined closure graph (K key nodes, E edges).

    Attributes:
        correction: ``(K, 4)`` C.
        inlier_probability: ``(E,)``.
        noise: the estimated noise model.
        variance: ``(K,)`` of one component of the orientation error relative to the root, rad².
        passes: number of sparse solves.
    """

    correction: Tensor
    inlier_probability: np.ndarray
    noise: NoiseModel
    variance: np.ndarray
    passes: int


def refine(
    graph: ClosureGraph,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    *,
    log_odds: np.ndarray | None = None,
    max_passes: int = MAX_PASSES,
) -> SlamEstimate:
    """Alternate solving and judging until neither moves.

    Args:
        correction: ``(K, 4)`` start; identities for the odometry itself.
        inlier_probability: ``(E,)`` start.
        noise: start.
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
        max_passes: sparse solves at most, at least 1.
    """
    prior = np.zeros(len(graph.source)) if log_odds is None else log_odds
    probes = probe_signs(graph.nodes[graph.source], graph.nodes[graph.target], _NUM_PROBES)
    components = noise.components
    odometry, closure = graph.is_odometry, graph.is_closure
    max_step_variance = _MAX_STEP_VARIANCE_GAIN * noise.step_variance
    passes = 0
    while True:
        variance = graph.steps * np.where(odometry, noise.step_variance, noise.closure_variance)
        weight = np.maximum(inlier_probability, 1e-9) / variance
        system = LaplacianSystem(graph.num_nodes, graph.source, graph.target, weight, graph.roots)
        step = system.fit(_residual_vectors(graph, correction))
        samples = system.samples(probes)
        correction = rotations.multiply(correction, rotations.exp(torch.from_numpy(step)))
        passes += 1

        residual = _residual_vectors(graph, correction)
        square = (residual**2).sum(axis=1)
        resistance = ((samples[graph.target] - samples[graph.source]) ** 2).mean(axis=1)
        leverage = np.clip(weight * resistance, 0.0, _MAX_LEVERAGE)
        predicted_square = np.minimum(square / (1 - leverage) ** 2, np.pi**2)
        predicted_variance = variance + resistance / (1 - leverage)
        judged = noise.inlier_log_odds(predicted_square, predicted_variance) + noise.prior_log_odds + prior
        probability = np.where(closure, expit(judged), 1.0)

        change = float(np.abs(probability - inlier_probability).max(initial=0.0))
        inlier_probability = probability
        redundancy = inlier_probability * (1 - leverage)
        square_per_step = square[odometry] / graph.steps[odometry]
        noise = NoiseModel(
            components,
            min(max_step_variance, _step_variance(square_per_step, redundancy[odometry], noise)),
            _closure_variance(square[closure], inlier_probability[closure], redundancy[closure], components),
            outlier_share(inlier_probability[closure]),
        )
        moved = float(np.abs(step).max(initial=0.0))
        if passes >= max_passes or (moved < _CONVERGED_STEP and change < _CONVERGED_PROBABILITY):
            break
    return SlamEstimate(rotations.normalize(correction), inlier_probability, noise, (samples**2).mean(axis=1), passes)


def _residual_vectors(graph: ClosureGraph, correction: Tensor) -> np.ndarray:
    residual = edge_residual(
        correction, graph.residual, torch.from_numpy(graph.source), torch.from_numpy(graph.target)
    )
    return rotations.log(residual).numpy()


def _step_variance(square_per_step: np.ndarray, redundancy: np.ndarray, noise: NoiseModel) -> float:
    prior = _PRIOR_ODOMETRY_REDUNDANCY * noise.components
    total = float(square_per_step.sum()) + prior * noise.step_variance
    return total / (float(redundancy.sum()) * noise.components + prior)


def _closure_variance(square: np.ndarray, probability: np.ndarray, redundancy: np.ndarray, components: int) -> float:
    return (float((probability * square).sum()) + _PRIOR_CLOSURE_SQUARE) / (float(redundancy.sum()) * components + 1)
