"""Moves that change the noise for the same labels: exponent of stated precisions, common errors, run length, tails."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import product

import numpy as np

from rotavg_ros.solver.slam.posterior.densities import log_good
from rotavg_ros.solver.slam.posterior.em import polish, settle
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.objective import log_noise_prior
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import tails, variances, with_noise
from rotavg_ros.solver.slam.posterior.state import (
    COMMON_SHARES,
    EXPONENTS,
    RUN_STEPS,
    STEP_TAIL_RATIOS,
    TAIL_SHARES,
    TURN_SHARES,
    Noise,
)

_Values = tuple[float, ...]
# Shares and variance ratios of odometry's tails, if it has any.
STEP_TAILS = tuple(product(TAIL_SHARES[1:], STEP_TAIL_RATIOS))
# The grids of values that are chosen together.
_GRIDS: dict[tuple[str, ...], tuple[_Values, ...]] = {
    ("turn_share",): tuple(product(TURN_SHARES)),
    ("step_tails", "step_tail_ratio"): ((TAIL_SHARES[0], STEP_TAIL_RATIOS[0]), *STEP_TAILS),
    ("closure_tails",): tuple(product(TAIL_SHARES)),
    ("exponent",): tuple(product(EXPONENTS)),
    ("run_steps",): tuple(product(RUN_STEPS)),
    ("common_share",): tuple(product(COMMON_SHARES)),
}
# If the logarithms of stated variances spread by less, weighting by them lowers the variance by at most 4 %.
_MIN_SPREAD = 0.2
# Values whose effect on F is not predicted: common errors are not a property of single edges.
_JOINT = (("run_steps",), ("common_share",))
# Factors of a variance that are tried in predicting F under other noise.
SCALES = np.exp(np.linspace(-3.6, 1.2, 25))
# Labels are also settled starting from a variance of odometry's steps that is this many times as large.
_WORSE_STEPS = 4.0
# Number of solves after which F is near its final value.
_FIRST_SOLVES = 2


def tuned(mode: Mode) -> Iterator[Mode]:
    """Modes of the same labels under other noise: one grid after the other, each from the best noise so far."""
    begun = mode
    for names in _GRIDS:
        left = _other_values(mode, names)
        while left:
            chosen = _next(mode, names, left)
            if chosen is None:
                break
            left.remove(chosen[0])
            found = _tried(mode, chosen[1])
            yield found
            mode = min(mode, found, key=lambda either: either.cost)
    if mode is not begun:
        yield _polished(mode, mode.state.noise)


def promised(mode: Mode) -> float:
    """Largest decrease of F, nats, predicted for the labels of a mode under other values of one grid."""
    least = 0.0
    for names in _GRIDS:
        if names not in _JOINT:
            predicted = (_predicted(mode, _with(mode, names, values))[0] for values in _other_values(mode, names))
            least = min(least, min(predicted, default=0.0))
    return -least


def propose_worse_odometry(mode: Mode) -> Iterator[Proposal]:
    """Proposes to settle labels from odometry that errs twice as much, if that leaves any label undecided.

    If odometry's variance is underestimated, the closures that would reveal it are labelled false, and without them the
    low variance seems right. Flipping single labels under that noise does not lead out of this.
    """
    problem, noise = mode.problem, mode.state.noise
    if _opens_labels(mode, _WORSE_STEPS):
        state = replace(mode.state, noise=replace(noise, step_variance=_WORSE_STEPS * noise.step_variance))
        yield Proposal("worse odometry", 0.0, partial(settle, problem, state), problem.limits.slack)


def _opens_labels(mode: Mode, factor: float) -> bool:
    """Whether some decided label would be undecided if its prediction had ``factor`` times the variance."""
    problem, told, closure = mode.problem, mode.left_out, mode.problem.closure
    noise = mode.state.noise
    own, tailed = variances(problem, noise)[closure], tails(problem, noise).of(closure)
    square, predicted = told.square[closure], told.predicted[closure]

    def log_density(predicted: np.ndarray) -> np.ndarray:
        return log_good(square, own, predicted, problem.components, tailed)[0]

    side, decided = np.sign(told.log_odds[closure]), problem.limits.slack
    changed = told.log_odds[closure] + log_density(factor * predicted) - log_density(predicted)
    return bool(((side * told.log_odds[closure] > decided) & (side * changed < decided)).any())


def _values(mode: Mode, names: tuple[str, ...]) -> _Values:
    return tuple(getattr(mode.state.noise, name) for name in names)


def _other_values(mode: Mode, names: tuple[str, ...]) -> list[_Values]:
    """The values of a grid that a mode does not have, if the graph has information on them."""
    if not _tells(mode, names[0]):
        return []
    now = _values(mode, names)
    return [values for values in _GRIDS[names] if values != now and _is_open(mode.problem, names, values)]


def _with(mode: Mode, names: tuple[str, ...], values: _Values) -> Noise:
    return replace(mode.state.noise, **dict(zip(names, values, strict=True)))


def _is_open(problem: Problem, names: tuple[str, ...], values: _Values) -> bool:
    """Whether a combination of values is switched on."""
    is_wide = "step_tail_ratio" in names and values[-1] > STEP_TAIL_RATIOS[0]
    return not (is_wide and "wide-tails" in problem.without)


def _next(mode: Mode, names: tuple[str, ...], left: list[_Values]) -> tuple[_Values, Noise] | None:
    """The values to try next, and the noise to begin with; None if none is promising.

    Values that act on single edges are tried in the order of the predicted F, while it rises by no more than the slack.
    If none qualifies, tails adjacent to the current ones on the grid are tried: other tails change the prediction of
    each edge, which the predicted F neglects.
    """
    noise = {values: _with(mode, names, values) for values in left}
    if names in _JOINT:
        return left[0], noise[left[0]]
    predicted = {values: _predicted(mode, each) for values, each in noise.items()}
    may_pay = [values for values in left if predicted[values][0] <= mode.problem.limits.slack]
    may_pay = may_pay or [values for values in left if _are_next(_values(mode, names), values)]
    if not may_pay:
        return None
    best = min(may_pay, key=lambda values: predicted[values][0])
    return best, predicted[best][1]


def _are_next(some: _Values, others: _Values) -> bool:
    """Whether two tails, both present, differ only in their share, or only by one place of the grid of ratios."""
    if len(some) < 2 or min(some[0], others[0]) == 0:
        return False
    places = abs(STEP_TAIL_RATIOS.index(some[1]) - STEP_TAIL_RATIOS.index(others[1]))
    return places == 0 or (places == 1 and some[0] == others[0])


def _predicted(mode: Mode, noise: Noise) -> tuple[float, Noise]:
    """Predicted change of F under other noise, if all other edges predict each edge as before.

    At the optimum this is exact to first order in the change of noise.

    Returns:
        nats, and the noise with the best variance of each kind of edge.
    """
    problem, told, good = mode.problem, mode.left_out, mode.state.is_good
    before, k = mode.state.noise, problem.components
    changed = log_noise_prior(before, problem.priors) - log_noise_prior(noise, problem.priors)
    own, others = variances(problem, noise)[: len(good)], variances(problem, before)[: len(good)]
    tailed, tailed_before = tails(problem, noise), tails(problem, before)
    best = []
    for kind in (problem.graph.is_odometry & good, problem.graph.is_closure & good):
        square, predicted = told.square[kind], told.predicted[kind]
        changed += float(log_good(square, others[kind], predicted, k, tailed_before.of(kind))[0].sum())
        scaled = SCALES[:, None] * own[kind]
        log_density = log_good(square, scaled, predicted, k, tailed.of(kind))[0].sum(axis=1)
        best.append(SCALES[int(log_density.argmax())])
        changed -= float(log_density.max())
    step, closure = best[0] * noise.step_variance, best[1] * noise.closure_variance
    return changed, replace(noise, step_variance=step, closure_variance=closure)


def uneven(problem: Problem, noise: Noise) -> Noise:
    """The noise with some odometry in the tails and with errors partly proportional to turns, where these are open."""
    tailed = noise.step_tails if "tails" in problem.without else TAIL_SHARES[1]
    return replace(noise, step_tails=tailed, turn_share=TURN_SHARES[1] if problem.turns_vary else noise.turn_share)


def _tried(mode: Mode, noise: Noise) -> Mode:
    """The mode's labels under other noise; not polished to the end if F is far above the mode's after a few solves."""
    limits = mode.problem.limits
    found = _polished(mode, noise, _FIRST_SOLVES)
    if found.cost > mode.cost + limits.rival:
        return found
    return _polished(found, found.state.noise, limits.trial_solves - _FIRST_SOLVES)


def _polished(mode: Mode, noise: Noise, solves: int | None = None) -> Mode:
    state = with_noise(mode.problem, mode.state, noise)
    return Mode(mode.problem, *polish(mode.problem, state, solves), "noise")


def _tells(mode: Mode, name: str) -> bool:
    """Whether the graph has information on a parameter of the noise, and it is not switched off."""
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
