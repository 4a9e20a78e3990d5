"""Densities of labels: which closures are false, one by one or as repeats of one wrong turn, and where odometry slips.

Rates that are not known are integrated over a grid, so that no labelling is judged by the rates of another one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import betaln

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.densities import log_false
from rotavg_ros.solver.slam.posterior.problem import Problem

# Nodes of the sums that stand for integrals over rates: the share of false closures and the probability that a label is
# its predecessor's; the shares of false closures that repeat a near one's turn and any one's; and what such repeats
# differ by, as a kernel's width.
_SHARES = np.array([0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
_STAY = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 0.97])
_NEAR_SHARES = np.array([0.05, 0.5, 0.95])
_FAR_SHARES = np.array([0.01, 0.05, 0.2, 0.5])
_REPEAT_DEG = 0.05 * 2.0 ** np.arange(9)
# One width for all, or each as likely for every closure.
_KERNELS = len(_REPEAT_DEG) + 1
_GRID_SIZE = len(_NEAR_SHARES) * len(_FAR_SHARES) * _KERNELS
# Of closures detected at about the same time, one from about the same older place counts for so many others.
_IN_RUN = 10.0
# A kernel ends at so many widths, where it is 4e-6 of its height.
_FARTHEST = 5.0
# The least density that counts.
_LEAST = 1e-300


@dataclass(frozen=True)
class FalseDensity:
    """Of n closures if they are false, in nats.

    Attributes:
        alone: ``(n,)`` wrong by themselves.
        near, far: ``(S, n)`` for each kernel, repeats of near and of any false closures; -inf without any.
    """

    alone: np.ndarray
    near: np.ndarray
    far: np.ndarray

    def mixed(self) -> np.ndarray:
        """``(G, n)`` log [(1 − c) ((1 − g) alone + g far) + c near], over the grid of c, g and the width."""
        far_share = np.where(np.isfinite(self.far), _FAR_SHARES[:, None, None], 0.0)
        near_share = np.where(np.isfinite(self.near), _NEAR_SHARES[:, None, None, None], 0.0)
        any_one = (1 - far_share) * np.exp(self.alone) + far_share * np.exp(self.far)
        both = (1 - near_share) * any_one + near_share * np.exp(self.near)
        return np.asarray(np.log(np.maximum(both, _LEAST)).reshape(_GRID_SIZE, len(self.alone)))


def false_density(
    problem: Problem, is_false: np.ndarray, residual: np.ndarray, rows: np.ndarray, both_sides: bool = False
) -> FalseDensity:
    """Closures wrong by themselves, or by the same turn of the world as other false ones.

    Places that look alike are mistaken for each other again and again. The density of a repeat is a kernel estimate
    over the false closures detected before (a Pólya urn), those detected shortly before weighing apart from all, and
    among these most those of the same run.

    Args:
        is_false: ``(C,)`` bool, of the others.
        residual: ``(C, 3)`` rad, of the closures, from source to target.
        rows: ``(n,)`` closures to be told of.
        both_sides: given all others, not those before alone.
    """
    k = problem.components
    alone = log_false((residual[rows] ** 2).sum(axis=1), k, problem.priors)
    nothing = np.full((_KERNELS, len(rows)), -np.inf)
    false = problem.detection[is_false[problem.detection]]
    if len(false) == 0 or len(rows) == 0 or "repeats" in problem.without:
        return FalseDensity(alone, nothing, nothing)
    when = problem.detected
    window = min(problem.limits.window, len(false))
    earlier = np.searchsorted(when[false], when[rows])
    place = earlier[:, None] + np.arange(-window, 0)
    if both_sides:
        place = np.concatenate((place, (earlier + is_false[rows])[:, None] + np.arange(window)), axis=1)
    there = (place >= 0) & (place < len(false))
    other = false[np.clip(place, 0, len(false) - 1)]
    turn = quaternion_rows.exp(np.ascontiguousarray((residual * problem.sign[:, None]).T)).T
    cosine = np.abs(np.einsum("ni,nwi->nw", turn[rows], turn[other]))
    square = (2 * np.arccos(np.minimum(cosine, 1.0))) ** 2
    apart = np.abs(problem.ends[other] - problem.ends[rows, None])
    is_near = there & (apart[:, :, 1] <= problem.priors.run_gap_steps)
    in_run = apart.sum(axis=2) <= problem.priors.run_gap_steps
    weights = [is_near * np.where(in_run, _IN_RUN, 1.0), there.astype(np.float64)]
    totals = [weight.sum(axis=1) for weight in weights]
    near, far = nothing.copy(), nothing.copy()
    alike = there & (square < (_FARTHEST * np.radians(_REPEAT_DEG[-1])) ** 2)
    row, square = np.nonzero(alike)[0], square[alike]
    weights = [weight[alike] for weight in weights]
    for number, width in enumerate(np.radians(_REPEAT_DEG)):
        height = (2 * np.pi * width**2) ** (-k / 2)
        kernel = np.exp(-square / (2 * width**2))
        for result, weight, total in zip((near, far), weights, totals, strict=True):
            mean = height * np.bincount(row, kernel * weight, len(rows)) / np.maximum(total, 1.0)
            result[number] = np.where(total > 0, np.log(np.maximum(mean, _LEAST)), -np.inf)
    for result in (near, far):
        result[-1] = np.logaddexp.reduce(result[:-1], axis=0) - np.log(len(_REPEAT_DEG))
    return FalseDensity(alone, near, far)


def _log_repeat_prior(problem: Problem) -> np.ndarray:
    """``(G,)`` of the grid's points: Beta(1, count) on the share that repeats a turn elsewhere, all else as likely."""
    far = (problem.priors.elsewhere_count - 1) * np.log1p(-_FAR_SHARES) + np.log(np.gradient(_FAR_SHARES))
    grid = np.broadcast_to(far[:, None], (len(_NEAR_SHARES), len(_FAR_SHARES), _KERNELS)).ravel()
    return np.asarray(grid - np.logaddexp.reduce(grid))


def repeat_rates(problem: Problem, density: FalseDensity) -> np.ndarray:
    """``(G,)`` log posterior of the grid's points, given false closures."""
    rates = density.mixed().sum(axis=1) + _log_repeat_prior(problem)
    return np.asarray(rates - np.logaddexp.reduce(rates))


def log_false_set(problem: Problem, density: FalseDensity) -> float:
    """Of all false closures together, rates and width integrated."""
    return float(np.logaddexp.reduce(density.mixed().sum(axis=1) + _log_repeat_prior(problem)))


def _log_transitions() -> tuple[np.ndarray, np.ndarray]:
    """Over the grid of shares and of staying: log P(first) ``(G, 2)`` and log P(next | last) ``(G, 2, 2)``."""
    share, stay = (values.ravel() for values in np.meshgrid(_SHARES, _STAY, indexing="ij"))
    first = np.stack((1 - share, share), axis=1)
    follows = (1 - stay)[:, None, None] * first[:, None, :] + stay[:, None, None] * np.eye(2)
    return np.log(first), np.log(follows)


_LOG_FIRST, _LOG_FOLLOWS = _log_transitions()
# Both as one matrix ``(G, 6)``: what each kind of step counts.
_LOG_STEPS = np.concatenate((_LOG_FIRST, _LOG_FOLLOWS.reshape(-1, 4)), axis=1)


def _log_grid_prior(problem: Problem) -> np.ndarray:
    """``(G,)`` of the grid's points: a Beta density on the shares, all stickiness as likely."""
    priors = problem.priors
    a = priors.outlier_share * priors.outlier_count
    b = (1 - priors.outlier_share) * priors.outlier_count
    log = (a - 1) * np.log(_SHARES) + (b - 1) * np.log1p(-_SHARES) + np.log(np.gradient(_SHARES))
    stay = np.where(_STAY > 0, -np.inf, 0.0) if "label-runs" in problem.without else np.zeros(len(_STAY))
    log = (log[:, None] + stay).ravel()
    return np.asarray(log - np.logaddexp.reduce(log))


def _kind_of_step(last: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Column of ``_LOG_STEPS``; ``last`` is 2 where there is none."""
    return np.asarray(np.where(last == 2, label, 2 + 2 * last + label))


def _last(problem: Problem, label: np.ndarray) -> np.ndarray:
    """``(C,)`` label of the closure that each follows, or 2."""
    return np.where(problem.follows >= 0, label[problem.follows], 2)


def log_label_prior(problem: Problem, is_false: np.ndarray) -> float:
    """Of all closures' labels: each is its predecessor's or drawn anew; the shares of either are integrated."""
    label = is_false.astype(np.int64)
    counts = np.bincount(_kind_of_step(_last(problem, label), label), minlength=_LOG_STEPS.shape[1])
    told = problem.log_odds[problem.closure]
    finite = np.where(np.isfinite(told), told, 0.0)
    return float(np.logaddexp.reduce(_LOG_STEPS @ counts + _log_grid_prior(problem)) - finite[is_false].sum())


def label_log_odds(problem: Problem, is_false: np.ndarray) -> np.ndarray:
    """``(C,)`` prior log-odds of each closure to be good, given the labels of all others."""
    label = is_false.astype(np.int64)
    if len(label) == 0:
        return np.zeros(0)
    last = _last(problem, label)
    log_rates = _LOG_STEPS @ np.bincount(_kind_of_step(last, label), minlength=_LOG_STEPS.shape[1])
    log_rates = log_rates + _log_grid_prior(problem)
    follower = np.flatnonzero(problem.follows >= 0)
    good, false = (
        np.bincount(problem.follows[follower], label[follower] == value, len(label)).astype(np.int64)
        for value in (0, 1)
    )
    # Closures with the same neighbours have the same odds.
    contexts, which = np.unique(np.stack((label, last, good, false)), axis=1, return_inverse=True)
    own, last, good, false = contexts

    def log_with(value: int) -> np.ndarray:
        changed = np.repeat(log_rates[:, None], len(own), axis=1)
        for sign, given in ((-1, own), (1, np.full(len(own), value))):
            changed += sign * _LOG_STEPS[:, _kind_of_step(last, given)]
            for count, next_label in ((good, 0), (false, 1)):
                changed += sign * count * _LOG_STEPS[:, _kind_of_step(given, np.full(len(own), next_label))]
        return np.asarray(np.logaddexp.reduce(changed, axis=0))

    odds = (log_with(0) - log_with(1))[which.reshape(-1)]
    return np.asarray(odds + problem.log_odds[problem.closure])


def log_slip_prior(problem: Problem, slipped: np.ndarray) -> float:
    """Of which segments slipped: Beta–binomial over all steps, and any step of a segment.

    The rate is integrated, so the first slip is dear and later ones are cheaper.

    Args:
        problem: the graph.
        slipped: edges.
    """
    priors, count, total = problem.priors, len(slipped), problem.total_steps
    prior = betaln(priors.slip_count + count, priors.slip_steps + total - count)
    steps = np.maximum(problem.graph.own_steps[slipped], 1.0)
    return float(prior - betaln(priors.slip_count, priors.slip_steps) + np.log(steps).sum())


def log_slip_odds(problem: Problem, steps: np.ndarray, slips: int) -> np.ndarray:
    """Prior log-odds of segments of ``steps`` ``(n,)`` to have slipped, given that ``slips`` have."""
    priors = problem.priors
    rate = (priors.slip_count + slips) / (priors.slip_steps + problem.total_steps)
    return np.asarray(np.log(rate * np.maximum(steps, 1.0)))
