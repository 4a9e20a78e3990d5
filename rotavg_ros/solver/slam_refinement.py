"""Robust refinement of a SLAM graph: Gauss–Newton on the closure graph, every closure judged by all the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from rotavg_ros.solver.agreement import AgreementPairs
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.common_error import closure_runs, common_share, variance_factor
from rotavg_ros.solver.noise_model import NoiseModel
from rotavg_ros.solver.slam_judging import exactness_of
from rotavg_ros.solver.slam_passes import Passes, SlamEstimate

MAX_PASSES = 30
# From the answer of a graph that has hardly changed since: on a real robot's graph, tick by tick, as good as 30.
WARM_PASSES = 10
# Of a graph that has grown by a few edges: passes at most, and when they end; the next update goes on from there.
_UPDATE_PASSES = 5
_UPDATED_STEP = np.radians(0.02)
_UPDATED_PROBABILITY = 0.02
# A graph that turns by more than this is solved as a whole.
_MAX_UPDATE = np.radians(20.0)
# Errors that closures share look like odometry noise in the fit. How odometry drifts over long ways tells otherwise, so
# the fit may raise that estimate by this factor at most, and not at all once closures are seen to err together.
_MAX_STEP_VARIANCE_GAIN = 1.5
_MIN_COMMON_SHARE = 0.06


def refine(
    graph: ClosureGraph,
    pairs: AgreementPairs,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    *,
    log_odds: np.ndarray | None = None,
    max_passes: int = MAX_PASSES,
    hold_noise: bool = False,
) -> SlamEstimate:
    """Alternate solving and judging until neither moves; once more if neighbouring closures err together.

    Args:
        pairs: the graph's neighbouring closures.
        correction: ``(K, 4)`` start; identities for the odometry itself.
        inlier_probability: ``(E,)`` start; that of odometry is kept.
        noise: start.
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
        max_passes: sparse solves at most, at least 1.
        hold_noise: keep both variances as given.
    """
    prior = np.zeros(len(graph.source)) if log_odds is None else log_odds
    state = Passes(graph, correction, inlier_probability, noise, prior, hold_noise)
    max_step_variance = _MAX_STEP_VARIANCE_GAIN * noise.step_variance
    state.alternate(max_step_variance, (max_passes + 1) // 2)
    share = 0.0
    closure = np.flatnonzero(graph.is_closure)
    if len(pairs.first) and state.passes < max_passes:
        good = state.inlier_probability[closure]
        older_end = np.minimum(graph.position[graph.source], graph.position[graph.target])[closure]
        run = closure_runs(pairs, good > 0.5, older_end)
        # Closures run old → new and new → old; their errors compare in one direction only.
        direction = np.where(graph.position[graph.source] < graph.position[graph.target], 1.0, -1.0)[closure, None]
        residual, samples = direction * state.residual[closure], direction * state.difference(state.samples)[closure]
        share = common_share(run, good, residual, samples, state.noise.closure_variance, noise.components)
        if share > _MIN_COMMON_SHARE:
            steps = graph.steps.copy()
            steps[closure] *= variance_factor(run, good, share)
            state.graph = replace(graph, steps=steps)
            state.noise = replace(state.noise, step_variance=min(noise.step_variance, state.noise.step_variance))
            max_step_variance = noise.step_variance
            state.alternate(max_step_variance, max_passes)
    return state.estimate(share, max_step_variance)


def update(
    graph: ClosureGraph,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    log_odds: np.ndarray,
    max_step_variance: float,
    rank: np.ndarray,
    exact_share: np.ndarray,
) -> SlamEstimate | None:
    """The same for a graph that has grown a little since :func:`refine`, from the verdicts and noise it ended with.

    Args:
        graph: with steps as :class:`SlamEstimate` has them.
        max_step_variance: as :class:`SlamEstimate` has it.
        rank: ``(K,)`` order of elimination.
        exact_share: as :class:`SlamEstimate` has it.

    Returns:
        None if orientations turn by so much that all has to be judged anew.
    """
    state = Passes(graph, correction, inlier_probability, noise, log_odds, False, rank)
    state.is_update = True
    state.exact_share = exact_share
    state.exactness = exactness_of(exact_share, noise.closure_variance)
    for _ in range(_UPDATE_PASSES):
        moved, changed = state.one_pass(max_step_variance, refresh=not state.has_predictions)
        if moved > _MAX_UPDATE:
            return None
        if moved < _UPDATED_STEP and changed < _UPDATED_PROBABILITY:
            break
    return state.estimate(0.0, max_step_variance) if state.has_predictions else None
