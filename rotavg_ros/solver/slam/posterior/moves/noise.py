"""Other noise for the same labels: how far stated precisions are believed, what closures share, and for how long."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from rotavg_ros.solver.slam.posterior.densities import log_good
from rotavg_ros.solver.slam.posterior.em import polish, settle
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.objective import log_noise_prior
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import tails, variances, with_noise
from rotavg_ros.solver.slam.posterior.state import COMMON_SHARES, EXPONENTS, RUN_STEPS, TAIL_SHARES, TURN_SHARES, Noise

_GRIDS = {
    "turn_share": TURN_SHARES,
    "step_tails": TAIL_SHARES,
    "closure_tails": TAIL_SHARES,
    "exponent": EXPONENTS,
    "run_steps": RUN_STEPS,
    "common_share": COMMON_SHARES,
}
# Where the logarithms of stated variances spread by less, weights could gain 4 % of variance at most.
_MIN_SPREAD = 0.2
# Values of a grid so many places from the best one are looked at.
_REACH = 2
# What errors have in common is no matter of single edges.
_JOINT = ("run_steps", "common_share")
# By what a variance changes when other noise is believed, at most and in steps.
_SCALES = np.exp(np.linspace(-2.0, 1.2, 17))
# Labels are settled from a variance of odometry's steps so many times as large, too.
_WORSE_STEPS = 4.0
# After so many solves F is about what it will be.
_FIRST_SOLVES = 2


def tuned(mode: Mode) -> Iterator[Mode]:
    """Modes of the same labels with other noise: values of one grid after the other, from the best so far."""
    begun = mode
    for name, grid in _GRIDS.items():
        if not _tells(mode, name):
            continue
        at = grid.index(getattr(mode.state.noise, name))
        for number in sorted(set(range(len(grid))) - {at}, key=lambda number: abs(number - at)):
            best = getattr(mode.state.noise, name)
            noise = replace(mode.state.noise, **{name: grid[number]})
            is_near = abs(number - grid.index(best)) <= _REACH
            if is_near and (name in _JOINT or _predicted(mode, noise) <= mode.problem.limits.slack):
                found = _tried(mode, noise)
                yield found
                mode = min(mode, found, key=lambda either: either.cost)
    if mode is not begun:
        yield _polished(mode, mode.state.noise)


def propose_worse_odometry(mode: Mode) -> Iterator[Proposal]:
    """Labels settled from odometry that errs twice as much, where that leaves any open.

    Odometry that is held for better than it is makes those closures false that would tell; without these it seems as
    good as it is held for. No single label leads out of that while noise stays.
    """
    problem, noise = mode.problem, mode.state.noise
    if _opens_labels(mode, _WORSE_STEPS):
        state = replace(mode.state, noise=replace(noise, step_variance=_WORSE_STEPS * noise.step_variance))
        yield Proposal("worse odometry", 0.0, partial(settle, problem, state), problem.limits.slack)


def _opens_labels(mode: Mode, factor: float) -> bool:
    """Whether a closure's label, decided now, would be open if what is predicted of it varied so many times as much."""
    problem, told, closure = mode.problem, mode.left_out, mode.problem.closure
    noise = mode.state.noise
    own, tailed = variances(problem, noise)[closure], tails(problem, noise)[closure]
    square, predicted, ratio = told.square[closure], told.predicted[closure], problem.priors.tail_ratio

    def log_density(predicted: np.ndarray) -> np.ndarray:
        return log_good(square, own, predicted, problem.components, tailed, ratio)[0]

    side, decided = np.sign(told.log_odds[closure]), problem.limits.slack
    changed = told.log_odds[closure] + log_density(factor * predicted) - log_density(predicted)
    return bool(((side * told.log_odds[closure] > decided) & (side * changed < decided)).any())


def _predicted(mode: Mode, noise: Noise) -> float:
    """By how much F changes, nats, if what others say of each edge stays, and each kind has its best variance.

    At the optimum that is the slope of F along the noise.
    """
    problem, told, good = mode.problem, mode.left_out, mode.state.is_good
    before = mode.state.noise
    changed = log_noise_prior(before, problem.priors) - log_noise_prior(noise, problem.priors)
    own, others = variances(problem, noise)[: len(good)], variances(problem, before)[: len(good)]
    share, share_before = tails(problem, noise), tails(problem, before)

    def log_density(kind: np.ndarray, variance: np.ndarray, tailed: np.ndarray) -> float:
        square, predicted, ratio = told.square[kind], told.predicted[kind], problem.priors.tail_ratio
        return float(log_good(square, variance[kind], predicted, problem.components, tailed[kind], ratio)[0].sum())

    for kind in (problem.graph.is_odometry & good, problem.graph.is_closure & good):
        changed += log_density(kind, others, share_before)
        changed -= max(log_density(kind, scale * own, share) for scale in _SCALES)
    return changed


def uneven(problem: Problem, noise: Noise) -> Noise:
    """The same but for odometry that errs by more now and then, and where it turns."""
    tailed = noise.step_tails if "tails" in problem.without else TAIL_SHARES[1]
    return replace(noise, step_tails=tailed, turn_share=TURN_SHARES[1] if problem.turns_vary else noise.turn_share)


def _tried(mode: Mode, noise: Noise) -> Mode:
    """The mode's labels under other noise; given up after a few solves where F is far above the mode's."""
    limits = mode.problem.limits
    found = _polished(mode, noise, _FIRST_SOLVES)
    if found.cost > mode.cost + limits.rival:
        return found
    return _polished(found, found.state.noise, limits.trial_solves - _FIRST_SOLVES)


def _polished(mode: Mode, noise: Noise, solves: int | None = None) -> Mode:
    state = with_noise(mode.problem, mode.state, noise)
    return Mode(mode.problem, *polish(mode.problem, state, solves), "noise")


def _tells(mode: Mode, name: str) -> bool:
    """Whether the graph has anything to say of it."""
    if name == "turn_share":
        return mode.problem.turns_vary
    if name in ("step_tails", "closure_tails"):
        return "tails" not in mode.problem.without
    good = ~mode.is_false
    if good.sum() < 2:
        return False
    if name == "common_share":
        return mode.problem.system(mode.state.noise).num_runs > 0
    if name == "run_steps":
        return "common-errors" not in mode.problem.without and len(mode.problem.run) > int(mode.problem.run.max()) + 1
    is_on = "stated-precisions" not in mode.problem.without
    return is_on and float(mode.problem.stated_ratio[good].std()) >= _MIN_SPREAD
