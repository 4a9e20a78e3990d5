"""Densities of labels: which closures are false, one by one or as repeats of one wrong turn, and where odometry slips.

Rates that are not known are integrated over a grid, so that no labelling is judged by the rates of another one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache

import numpy as np
from scipy.special import betaln

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.repeats import KERNELS, Closures, Near, Repeats, places_near, repeats
from rotavg_ros.solver.slam.posterior.densities import anyhow, log_false
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem

# Nodes of the sums that stand for integrals over rates: the share of false closures and the probability that a label is
# its predecessor's; the shares of false closures that repeat their run's turn, that of one shortly before and any
# one's; and of those that repeat none but are near misses.
_SHARES = np.array([0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
_STAY = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 0.97])
_RUN_SHARES = np.array([0.05, 0.5, 0.95])
_NEAR_SHARES = np.array([0.05, 0.5, 0.95])
_FAR_SHARES = np.array([0.01, 0.05, 0.2, 0.5])
_NEAR_MISS_QUANTILES = np.array([1.0, 3.0, 5.0]) / 6
# Of false closures of a robot that stays upright, that are wrong by a turn about the vertical if any are.
_ABOUT_VERTICAL = 0.9
# Predicted to less than this share of the variance of any rotation.
_TOLD = 0.5
# The least density that counts; a product is turned into its logarithm beyond these.
_LEAST, _SMALL, _LARGE = 1e-100, 1e-100, 1e100


def _grid(kinds: int) -> tuple[int, ...]:
    """Of rates, for so many densities of false closures that are wrong by themselves."""
    return len(_RUN_SHARES), len(_NEAR_SHARES), len(_FAR_SHARES), kinds, KERNELS


@dataclass(frozen=True)
class FalseDensity:
    """Of n closures if they are false, none of them as a logarithm.

    Attributes:
        alone: ``(M, n)`` wrong by themselves, for each share of near misses; and again where most turns are about the
            vertical, if the robot knows one.
        repeats: by the turns of others, of which some may be there.
    """

    alone: np.ndarray
    repeats: Repeats

    def log_sums(self) -> np.ndarray:
        """``(G,)`` logarithms of all closures together, at each point of the grid of rates.

        Each is (1 − c) ((1 − d) ((1 − g) alone + g of any) + d of those before) + c of its run, where there are such.
        """
        return _log_sums(self.alone, *self.repeats, (_RUN_SHARES, _NEAR_SHARES, _FAR_SHARES))

    def mean(self, log_rates: np.ndarray) -> np.ndarray:
        """``(n,)`` the same of each in the mean over the grid, whose points have these logarithms ``(G,)``.

        It is linear in all four, so what each counts for is summed over the grid beforehand.
        """
        rates = np.exp(log_rates).reshape(_grid(len(self.alone)))
        shares = np.ix_(_RUN_SHARES, _NEAR_SHARES, _FAR_SHARES)
        c, d, g = (share[..., None, None] for share in shares)
        mean = np.zeros(self.alone.shape[1])
        has_any = self.repeats.has_any
        for has in np.ndindex(2, 2, 2):
            rows = np.flatnonzero((has_any == np.array(has, dtype=bool)[:, None]).all(axis=0))
            if len(rows) == 0:
                continue
            of_run, before, of_any = c * has[0], (1 - c * has[0]) * d * has[1], (1 - c * has[0]) * (1 - d * has[1])
            alone = (rates * of_any * (1 - g * has[2])).sum(axis=(0, 1, 2, 4))
            mean[rows] = alone @ self.alone[:, rows]
            for share, density in zip((of_run, before, of_any * g * has[2]), self.repeats.density, strict=True):
                mean[rows] += (rates * share).sum(axis=(0, 1, 2, 3)) @ density[:, rows]
        return np.asarray(np.maximum(mean, _LEAST))


@compiled
def _log_sums(
    alone: np.ndarray,
    density: np.ndarray,
    has_any: np.ndarray,
    shares: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Products of what :meth:`FalseDensity.log_sums` says of each closure, logarithms taken where they get small."""
    of_run, before, of_any = shares
    size = len(of_run) * len(before) * len(of_any) * len(alone) * density.shape[1]
    product, total = np.ones(size), np.zeros(size)
    for n in range(alone.shape[1]):
        at = 0
        for c in of_run:
            for d in before:
                for g in of_any:
                    run = c if has_any[0, n] else 0.0
                    near = (1 - run) * (d if has_any[1, n] else 0.0)
                    rest = 1 - run - near
                    far = rest * (g if has_any[2, n] else 0.0)
                    for m in range(len(alone)):
                        by_itself = (rest - far) * alone[m, n]
                        for s in range(density.shape[1]):
                            each = by_itself + far * density[2, s, n] + near * density[1, s, n] + run * density[0, s, n]
                            product[at] *= max(each, _LEAST)
                            if not _SMALL < product[at] < _LARGE:
                                total[at] += math.log(product[at])
                                product[at] = 1.0
                            at += 1
    return total + np.log(product)


def false_density(
    problem: Problem,
    is_false: np.ndarray,
    residual: np.ndarray,
    predicted: np.ndarray,
    rows: np.ndarray,
    both_sides: bool = False,
) -> FalseDensity:
    """Closures wrong by themselves, or by the same turn of the world as other false ones.

    The density of a repeat is a kernel estimate over the false closures detected before (a Pólya urn), those near
    weighing apart from all (:mod:`~rotavg_ros.solver.slam.noise.repeats`).

    Args:
        is_false: ``(C,)`` bool, of the others.
        residual: ``(C, 3)`` rad, of the closures, from source to target.
        predicted: ``(C,)`` rad², variance of what these are counted from.
        rows: ``(n,)`` closures to be told of.
        both_sides: given all others, not those before alone.
    """
    k, count = problem.components, len(rows)
    square = (residual[rows] ** 2).sum(axis=1)
    near_misses = _near_miss_shares(problem.priors)[:, None]
    alone = np.exp(log_false(square, k, problem.priors, near_misses, predicted[rows]))
    if problem.vertical is not None:
        uniform = (1 - near_misses) * np.exp(log_uniform_density(np.sqrt(square), k))
        ratio = problem.vertical.density_ratio(residual[rows], predicted[rows])
        alone = np.concatenate((alone, alone + _ABOUT_VERTICAL * uniform * (ratio - 1)))
    if count == 0 or not is_false.any() or "repeats" in problem.without:
        return FalseDensity(alone, Repeats.none(count))
    older, newer = problem.ends.T
    turn = np.ascontiguousarray(quaternion_rows.exp((residual * problem.sign[:, None]).T).T)
    # Of a closure that nothing else predicts it is not known by what turn it is wrong.
    is_told = predicted < _TOLD * anyhow(k)
    false = problem.detection[is_false[problem.detection]]
    is_one = is_false[rows] if both_sides else None
    between = places_near(problem.detected[false], problem.detected[rows], is_one, problem.limits.window)
    closures, near = Closures(older, newer, turn, is_told), Near(rows, false, between)
    return FalseDensity(alone, repeats(closures, near, problem.priors.run_gap_steps, k))


def _near_miss_shares(priors: SlamPriors) -> np.ndarray:
    """``(M,)`` equally likely under Beta(1, b), whose mean is the share that is believed: 1 − (1 − u)^(1/b)."""
    mean = priors.near_miss_share
    return np.asarray(-np.expm1(mean / (1 - mean) * np.log1p(-_NEAR_MISS_QUANTILES)))


@cache
def _log_repeat_prior(priors: SlamPriors, kinds: int) -> np.ndarray:
    """``(G,)`` of the grid's points: Beta(1, count) on the share that repeats a turn elsewhere, all else as likely."""
    far = (priors.elsewhere_count - 1) * np.log1p(-_FAR_SHARES) + np.log(np.gradient(_FAR_SHARES))
    grid = np.broadcast_to(far[:, None, None], _grid(kinds)).ravel()
    return np.asarray(grid - np.logaddexp.reduce(grid))


def repeat_rates(problem: Problem, density: FalseDensity) -> np.ndarray:
    """``(G,)`` log posterior of the grid's points, given false closures."""
    rates = density.log_sums() + _log_repeat_prior(problem.priors, len(density.alone))
    return np.asarray(rates - np.logaddexp.reduce(rates))


def log_false_set(problem: Problem, density: FalseDensity) -> float:
    """Of all false closures together, rates and width integrated."""
    log_prior = _log_repeat_prior(problem.priors, len(density.alone))
    return float(np.logaddexp.reduce(density.log_sums() + log_prior))


def _log_transitions() -> tuple[np.ndarray, np.ndarray]:
    """Over the grid of shares and of staying: log P(first) ``(G, 2)`` and log P(next | last) ``(G, 2, 2)``."""
    share, stay = (values.ravel() for values in np.meshgrid(_SHARES, _STAY, indexing="ij"))
    first = np.stack((1 - share, share), axis=1)
    follows = (1 - stay)[:, None, None] * first[:, None, :] + stay[:, None, None] * np.eye(2)
    return np.log(first), np.log(follows)


_LOG_FIRST, _LOG_FOLLOWS = _log_transitions()
# Both as one matrix ``(G, 6)``: what each kind of step counts.
_LOG_STEPS = np.concatenate((_LOG_FIRST, _LOG_FOLLOWS.reshape(-1, 4)), axis=1)


@cache
def _log_grid_prior(priors: SlamPriors, has_runs: bool) -> np.ndarray:
    """``(G,)`` of the grid's points: a Beta density on the shares, all stickiness as likely, or none."""
    a = priors.outlier_share * priors.outlier_count
    b = (1 - priors.outlier_share) * priors.outlier_count
    log = (a - 1) * np.log(_SHARES) + (b - 1) * np.log1p(-_SHARES) + np.log(np.gradient(_SHARES))
    stay = np.zeros(len(_STAY)) if has_runs else np.where(_STAY > 0, -np.inf, 0.0)
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
    return float(
        np.logaddexp.reduce(_LOG_STEPS @ counts + _log_grid_prior(problem.priors, "label-runs" not in problem.without))
        - finite[is_false].sum()
    )


def label_log_odds(problem: Problem, is_false: np.ndarray) -> np.ndarray:
    """``(C,)`` prior log-odds of each closure to be good, given the labels of all others."""
    label = is_false.astype(np.int64)
    if len(label) == 0:
        return np.zeros(0)
    last = _last(problem, label)
    log_rates = _LOG_STEPS @ np.bincount(_kind_of_step(last, label), minlength=_LOG_STEPS.shape[1])
    log_rates = log_rates + _log_grid_prior(problem.priors, "label-runs" not in problem.without)
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
