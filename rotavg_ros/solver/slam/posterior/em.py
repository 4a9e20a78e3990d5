"""Expectation–maximisation around the sparse solve: corrections, noise and, where asked for, labels."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import expit

from rotavg_ros.solver.slam.noise.vertical import Vertical
from rotavg_ros.solver.slam.posterior.left_out import leave_one_out
from rotavg_ros.solver.slam.posterior.objective import Evaluation, evaluate
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import (
    moved,
    residuals,
    sites,
    variances,
    weights,
    weights_if_good,
    with_others,
)
from rotavg_ros.solver.slam.posterior.state import Noise, State
from rotavg_ros.solver.slam.posterior.system import Factorised

# Noise and labels are not estimated while orientations still turn by more than this, for at most this many solves.
_SETTLED_TURN = np.radians(3.0)
_MAX_UNSETTLED = 5
_PROBABILITY_CONVERGED = 0.02
# Noise that converges by a constant factor of at most this from solve to solve is set to the limit.
_SLOWEST = 0.85
# Newton steps to the logarithm of the likeliest variance, the change at which they stop, and the largest distance of
# the result from the prior's median, in standard deviations.
_NEWTON_STEPS, _NEWTON_CONVERGED, _FARTHEST = 20, 1e-9, 5.0


class Step(NamedTuple):
    """One Gauss–Newton step on the corrections.

    Attributes:
        state: the state after it.
        turned: largest component of the turns, rad.
        gained: nats, decrease of −log p of the residuals, ½ δᵀ H δ.
        factorised: H.
    """

    state: State
    turned: float
    gained: float
    factorised: Factorised


def step(problem: Problem, state: State, *, all_rows: bool = True) -> Step:
    """One Gauss–Newton step, which also updates the prediction of each edge by all others.

    Args:
        problem: the graph.
        state: the state before.
        all_rows: whether to update the predictions of edges of no weight, too.
    """
    residual, variance = residuals(problem, state), variances(problem, state.noise)
    own = variance[: len(problem.graph.source)]
    if_good = weights_if_good(state, own, sites(problem, state, residual, variance))
    factorised = problem.system(state.noise).factorise(weights(problem, state, if_good, variance))
    slope = factorised.gradient(residual)
    turn = factorised.solve(slope)
    state = with_others(moved(state, turn), factorised, if_good, own, problem.components, all_rows=all_rows)
    return Step(state, float(np.abs(turn).max(initial=0.0)), float((slope * turn).sum()) / 2, factorised)


def polish(
    problem: Problem, state: State, solves: int | None = None, *, hold_noise: bool = False
) -> tuple[State, Evaluation]:
    """Optimises corrections and noise with fixed labels.

    Args:
        problem: the graph.
        state: where to begin; labels that a user has set hold, whatever it has.
        solves: maximum number, exceeded only while a solve still gains much; default: that of the limits.
        hold_noise: leave the noise as it is.
    """
    enough = problem.limits.polish_solves if solves is None else solves
    state = replace(state, trusted=problem.allowed(state.trusted))
    last, gained = np.zeros(2), np.inf
    for number in range(problem.limits.polish_solves):
        if number >= enough and gained < problem.limits.rival:
            break
        state, turned, gained, factorised = step(problem, state, all_rows=False)
        is_settled = gained < problem.limits.converged
        if not hold_noise and turned < _SETTLED_TURN:
            before = state.noise
            noise, last = _extrapolated(before, estimate_noise(problem, state, factorised), last)
            state = replace(state, noise=noise)
            is_settled &= _gained(problem, before, noise) < problem.limits.converged
        if is_settled:
            break
    evaluation = evaluate(problem, state, is_moving=gained > problem.limits.rival)
    return replace(state, others=evaluation.others), evaluation


def polish_fully(problem: Problem, state: State) -> tuple[State, Evaluation]:
    """The same for a state that may be far from its optimum, as where many labels changed at once."""
    state, evaluation = polish(problem, state)
    while True:
        before = evaluation.total
        state, evaluation = polish(problem, state)
        if not evaluation.total < before - problem.limits.slack:
            return state, evaluation


def _extrapolated(before: Noise, after: Noise, last: np.ndarray) -> tuple[Noise, np.ndarray]:
    """The extrapolated limit of a sequence of noises (Aitken 1926), and the latest change.

    Args:
        before: noise of the last solve.
        after: noise estimated from it.
        last: ``(2,)`` previous changes of the logarithms of both variances; zero where these must not be extrapolated.
    """
    change = np.log([after.step_variance / before.step_variance, after.closure_variance / before.closure_variance])
    ratio = float(change @ last) / max(float(last @ last), np.finfo(np.float64).tiny)
    if not last.any() or not ratio < _SLOWEST:
        return after, change
    # If the sequence alternates, the ratio is negative and the limit lies between the last two values.
    step, closure = np.exp(change * ratio / (1 - ratio)).tolist()
    farther = replace(
        after, step_variance=after.step_variance * step, closure_variance=after.closure_variance * closure
    )
    return farther, np.zeros(2)


def settle(problem: Problem, state: State, solves: int | None = None) -> State:
    """Optimises closures' labels and corrections together; labels are probabilities meanwhile, rounded at the end.

    Args:
        problem: the graph.
        state: where to begin.
        solves: maximum number; default: that of the limits.
    """
    closure = problem.closure
    told = problem.log_odds[closure]
    for number in range(problem.limits.settling_solves if solves is None else solves):
        state, turned, gained, factorised = step(problem, state)
        if turned > _SETTLED_TURN and number < _MAX_UNSETTLED:
            continue
        left_out = leave_one_out(problem, state, factorised)
        trusted = state.trusted.copy()
        trusted[closure] = np.where(np.isfinite(told), expit(left_out.log_odds[closure]), told > 0)
        changed = float(np.abs(trusted - state.trusted).max(initial=0.0))
        state = replace(state, trusted=trusted)
        state = replace(state, noise=estimate_noise(problem, state, factorised))
        if changed < _PROBABILITY_CONVERGED and gained < problem.limits.converged:
            break
    return replace(state, trusted=state.is_good.astype(np.float64))


def estimate_noise(problem: Problem, state: State, factorised: Factorised) -> Noise:
    """Both variances from residuals and their effective redundancy (Gull 1989, MacKay 1992), under their priors."""
    priors, noise, k = problem.priors, state.noise, problem.components
    num_edges = len(problem.graph.source)
    variance, residual = variances(problem, noise), residuals(problem, state)
    site = sites(problem, state, residual, variance)
    common = variance[num_edges:]
    # A run's prior is a row like any other, but has no tails.
    of_runs = 1 - np.minimum(factorised.resistance_of_kept[num_edges:] / common, 1.0)
    redundancy = k * np.concatenate((state.trusted * site.shrinkage, of_runs))
    square = np.concatenate((state.trusted * site.misfit, (residual[num_edges:] ** 2).sum(axis=1) / common))
    is_step = np.concatenate((problem.graph.is_odometry, np.zeros(len(common), dtype=bool)))
    is_other = ~is_step
    is_step[problem.beside] = False

    def likeliest(rows: np.ndarray, before: float, median: float) -> float:
        squares, freedom = before * float(square[rows].sum()), float(redundancy[rows].sum())
        return likeliest_variance(squares, freedom, np.log(before), np.log(median), priors.noise_spread)

    step = likeliest(is_step, noise.step_variance, np.radians(priors.step_deg) ** 2)
    beside = 1.0
    if len(problem.beside):
        beside = likeliest(problem.beside, noise.beside * noise.step_variance, step) / step
    return replace(
        noise,
        step_variance=step,
        closure_variance=likeliest(is_other, noise.closure_variance, np.radians(priors.closure_deg) ** 2),
        beside=beside,
        step_told=_step_told(problem, state, factorised.weight, residual),
    )


def _step_told(problem: Problem, state: State, weight: np.ndarray, residual: np.ndarray) -> float:
    """Effective number of components of odometry's error, relative to k: k_eff / k.

    Where gravity holds roll and pitch, or odometry is worse about one body axis than about the others, its squared
    errors are those of about one normal component rather than of three smaller ones. Taken for three components, they
    seem to have tails. A sum of squares of normal components with shares q of the variance is approximately χ² with
    k_eff = 1 / Σ q² degrees of freedom (Satterthwaite 1946).

    Args:
        problem: the graph.
        state: the state after a solve.
        weight: ``(E + R,)`` rad⁻², weights in it.
        residual: ``(E + R, 3)`` rad after it.
    """
    graph = problem.graph
    sound = np.flatnonzero(graph.is_odometry & state.is_good)
    if problem.components == 1 or "tilt" in problem.without or len(sound) == 0:
        return 1.0
    bodies, heavy, left = problem.body_from_world(state.correction), weight[sound], residual[sound]
    # As if one more edge erred alike about all axes.
    square = np.eye(3)
    for end in (graph.source, graph.target):
        at_end = np.einsum("eij,ej->ei", bodies[end[sound]], left)
        square += (heavy * at_end.T) @ at_end / 2
    told = float(square.trace() ** 2 / (square**2).sum() / 3)
    return told if problem.upright is None else min(told, _told_upright(problem.upright, heavy, left))


def _told_upright(vertical: Vertical, weight: np.ndarray, residual: np.ndarray) -> float:
    """The same for the vertical and the other axes, from ``(n,)`` weights and ``(n, 3)`` residuals in the world."""
    axis = vertical.sharpened(residual, 1 / weight)
    # The variance about the other axes is at most that about the vertical.
    about = 1 + float(weight @ (residual @ axis) ** 2)
    share = max(about / (3 + float(weight @ (residual**2).sum(axis=1))), 1 / 3)
    return 1 / (share**2 + (1 - share) ** 2 / 2) / 3


def likeliest_variance(squares: float, freedom: float, log_variance: float, log_prior: float, spread: float) -> float:
    """The variance e^x that maximises −n/2 x − S/2 e⁻ˣ − (x − prior)²/(8 spread²), by Newton steps.

    Args:
        squares: S.
        freedom: n.
        log_variance: initial x.
        log_prior: logarithm of the prior's median variance.
        spread: standard deviation of the logarithm of its square root.
    """
    x = log_variance
    for _ in range(_NEWTON_STEPS):
        curved = squares / 2 * math.exp(-x)
        slope = curved - freedom / 2 - (x - log_prior) / (4 * spread**2)
        change = max(-1.0, min(1.0, slope / (curved + 1 / (4 * spread**2))))
        x += change
        if abs(change) < _NEWTON_CONVERGED:
            break
    return float(np.exp(np.clip(x, log_prior - 2 * _FARTHEST * spread, log_prior + 2 * _FARTHEST * spread)))


def _gained(problem: Problem, before: Noise, after: Noise) -> float:
    """Approximate decrease of F, nats: n components determine their log variance with a precision of ½ n."""
    steps = np.log(after.step_variance / before.step_variance) ** 2 * problem.graph.num_segments
    closures = np.log(after.closure_variance / before.closure_variance) ** 2 * len(problem.closure)
    beside = np.log(after.beside / before.beside) ** 2 * len(problem.beside)
    return float(problem.components / 4 * (steps + closures + beside))
