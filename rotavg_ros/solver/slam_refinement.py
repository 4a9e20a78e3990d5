"""Robust refinement of a SLAM graph: Gauss–Newton on the closure graph, every closure judged by all the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from rotavg_ros.solver.agreement import AgreementPairs
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.common_error import closure_runs, common_share, variance_factor
from rotavg_ros.solver.drift_posterior import expected_step_variance
from rotavg_ros.solver.moved_slips import with_moved_slips
from rotavg_ros.solver.noise_model import NoiseModel
from rotavg_ros.solver.slam_passes import Passes, SlamEstimate
from rotavg_ros.solver.slam_system import WholeSystem

MAX_PASSES = 30
# From the answer of a graph that has hardly changed since: on a real robot's graph, tick by tick, as good as 30.
WARM_PASSES = 10
# Errors that closures share look like odometry noise in the fit. How odometry drifts over long ways tells otherwise, so
# the fit may raise that estimate by this factor at most, and not at all once closures are seen to err together.
_MAX_STEP_VARIANCE_GAIN = 1.5
_MIN_COMMON_SHARE = 0.06
# In larger graphs the likeliest drift is near what is believed.
_MAX_NODES_TO_DRAW_AGAIN = 2000


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
    rank: np.ndarray | None = None,
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
        rank: ``(K,)`` where each key node stands in the order of elimination, if that is known.
    """
    prior = np.zeros(len(graph.source)) if log_odds is None else log_odds
    system = WholeSystem(graph, rank)
    state = Passes(graph, correction, inlier_probability, noise, prior, hold_noise, system)
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
        residual, samples = direction * state.residual[closure], direction * state.difference(system.samples)[closure]
        share = common_share(run, good, residual, samples, state.noise.closure_variance, noise.components)
        if share > _MIN_COMMON_SHARE:
            steps = graph.steps.copy()
            steps[closure] *= variance_factor(run, good, share)
            state.graph = replace(graph, steps=steps)
            state.noise = replace(state.noise, step_variance=min(noise.step_variance, state.noise.step_variance))
            max_step_variance = noise.step_variance
            state.alternate(max_step_variance, max_passes)
    return estimate(state, system, share, max_step_variance)


def estimate(state: Passes, system: WholeSystem, share: float, max_step_variance: float) -> SlamEstimate:
    """What there is to say after the last pass."""
    step_variance = state.noise.step_variance if state.hold_noise else _stated_step_variance(state)
    if step_variance != state.noise.step_variance:
        # What the solution does to errors of this size, though it takes odometry for better than that.
        error = system.probes / np.sqrt(state.weight(replace(state.noise, step_variance=step_variance)))[:, None]
        samples = system.factorised.fit(error)
    else:
        samples = system.samples
    verdicts = state.verdicts()
    if not state.hold_noise:
        samples = with_moved_slips(
            samples,
            state.graph,
            verdicts.correction,
            state.inlier_probability,
            state.noise,
            state.prior_log_odds,
        )
    return SlamEstimate(
        **vars(verdicts),
        samples=samples,
        stated_step_variance=step_variance,
        common_share=share,
        passes=state.passes,
        max_step_variance=max_step_variance,
        rank=system.pattern.rank,
        factorised=system.factorised,
    )


def _stated_step_variance(state: Passes) -> float:
    """Of the odometry, rad² per step, as uncertainty is stated by it.

    Where closures are few, drift is taken to be less than it probably is, for the sake of the verdicts.
    """
    graph, noise = state.graph, state.noise
    has_slips = bool((state.inlier_probability[graph.is_odometry] < 0.5).any())
    if not has_slips:
        expected = expected_step_variance(graph, state.inlier_probability, noise.closure_variance, noise.components)
        if np.isfinite(expected):
            return expected
    if graph.num_nodes <= _MAX_NODES_TO_DRAW_AGAIN:
        return max(noise.step_variance, noise.likely_step_variance)
    return noise.step_variance
