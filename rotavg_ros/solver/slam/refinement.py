"""Robust refinement of a SLAM graph: Gauss–Newton on the closure graph, every closure judged by all the others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.moves.moved_slips import with_moved_slips
from rotavg_ros.solver.slam.noise.common_error import RunErrors, closure_runs, common_share, variance_factor
from rotavg_ros.solver.slam.noise.drift_posterior import expected_step_variance
from rotavg_ros.solver.slam.noise.stated_precision import NO_TRUST, StatedTrust, believing, estimate_trust
from rotavg_ros.solver.slam.passes.alternation import Passes, SlamEstimate, Start
from rotavg_ros.solver.slam.passes.group_verdicts import false_groups
from rotavg_ros.solver.slam.passes.system import WholeSystem

MAX_PASSES = 30
# From the answer of a graph that has hardly changed since: on a real robot's graph, tick by tick, as good as 30.
WARM_PASSES = 10
# Errors that closures share look like odometry noise in the fit. How odometry drifts over long ways tells otherwise, so
# the fit may raise that estimate by this factor at most, and not at all once closures are seen to err together.
_MAX_STEP_VARIANCE_GAIN = 1.5
_MIN_COMMON_SHARE = 0.06
# Where what closures state is believed, they are judged anew by so many passes before it is asked whether they err
# together.
_BELIEVING_PASSES = 3
# In larger graphs the likeliest drift is near what is believed.
_MAX_NODES_TO_DRAW_AGAIN = 2000


def refine(
    start: Start,
    pairs: AgreementPairs,
    *,
    max_passes: int = MAX_PASSES,
    hold_noise: bool = False,
    rank: np.ndarray | None = None,
) -> SlamEstimate:
    """Alternate solving and judging until neither moves; once more if neighbouring closures err together.

    Args:
        pairs: the graph's neighbouring closures.
        max_passes: sparse solves at most, at least 1.
        hold_noise: keep both variances as given.
        rank: ``(K,)`` where each key node stands in the order of elimination, if that is known.
    """
    graph, noise = start.graph, start.noise
    system = WholeSystem(graph, rank)
    state = Passes(start, system, hold_noise)
    max_step_variance = _MAX_STEP_VARIANCE_GAIN * noise.step_variance
    state.alternate(max_step_variance, (max_passes + 1) // 2)
    share, trust = 0.0, NO_TRUST
    in_false_group = np.zeros(len(graph.source), dtype=bool)
    if len(pairs.first) and not hold_noise:
        in_false_group[graph.is_closure] = false_groups(state, system, pairs)
    if len(pairs.first) and state.passes < max_passes:
        run = _runs(state, pairs)
        share = _common_share(state, system, run)
        trust = NO_TRUST if hold_noise or not state.has_predictions else _estimate_trust(state, run, share)
        is_believed = trust.exponent > 0
        if is_believed:
            state.weigh_anew(believing(graph, trust))
            state.alternate(max_step_variance, min(state.passes + _BELIEVING_PASSES, max_passes))
            run = _runs(state, pairs)
            share = _common_share(state, system, run)
        if share > _MIN_COMMON_SHARE:
            bounded = replace(state.noise, step_variance=min(noise.step_variance, state.noise.step_variance))
            state.weigh_anew(_with_common_errors(state, run, share), bounded)
            max_step_variance = noise.step_variance
        if (share > _MIN_COMMON_SHARE or is_believed) and state.passes < max_passes:
            state.alternate(max_step_variance, max_passes)
    refined = estimate(state, system, share, trust, max_step_variance)
    return replace(refined, in_false_group=in_false_group)


def _estimate_trust(state: Passes, run: np.ndarray, share: float) -> StatedTrust:
    closure = np.flatnonzero(state.graph.is_closure)
    good = state.inlier_probability[closure]
    return estimate_trust(
        state.noise,
        state.graph.stated_variance[closure],
        good,
        state.discrepancy**2,
        state.system.prediction_variance[closure],
        1 / variance_factor(run, good, share),
    )


def _runs(state: Passes, pairs: AgreementPairs) -> np.ndarray:
    graph, closure = state.graph, np.flatnonzero(state.graph.is_closure)
    older_end = np.minimum(graph.position[graph.source], graph.position[graph.target])[closure]
    return closure_runs(pairs, state.inlier_probability[closure] > 0.5, older_end)


def _with_common_errors(state: Passes, run: np.ndarray, share: float) -> ClosureGraph:
    graph, closure = state.graph, np.flatnonzero(state.graph.is_closure)
    steps = graph.own_steps.copy()
    steps[closure] *= variance_factor(run, state.inlier_probability[closure], share)
    return replace(graph, steps=steps)


def _common_share(state: Passes, system: WholeSystem, run: np.ndarray) -> float:
    graph = state.graph
    closure = np.flatnonzero(graph.is_closure)
    # Closures run old → new and new → old; their errors compare in one direction only.
    direction = np.where(graph.position[graph.source] < graph.position[graph.target], 1.0, -1.0)[closure, None]
    errors = RunErrors(
        run,
        state.inlier_probability[closure],
        direction * state.residual[closure],
        graph.own_steps[closure],
        direction * state.difference(system.samples)[closure],
    )
    return common_share(errors, state.noise.closure_variance, state.noise.components)


def estimate(
    state: Passes, system: WholeSystem, share: float, trust: StatedTrust, max_step_variance: float
) -> SlamEstimate:
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
            state.network_log_odds,
        )
    return SlamEstimate(
        **vars(verdicts),
        samples=samples,
        stated_step_variance=step_variance,
        common_share=share,
        trust=trust,
        passes=state.passes,
        max_step_variance=max_step_variance,
        rank=system.pattern.rank,
        factorised=system.factorised,
        in_false_group=np.zeros(len(state.graph.source), dtype=bool),
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
