"""The density of false closures: each wrong independently, or repeating one wrong turn."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache
from typing import NamedTuple

import numpy as np
from scipy.special import softmax

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.repeats import KERNELS, Closures, Near, Repeats, log_widths, places_near, repeats
from rotavg_ros.solver.slam.posterior.densities import anyhow, log_false
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import State

# Grids that replace integrals over rates: the shares of false closures that repeat the turn of their run, of one
# shortly before, and of any other; and the share of near misses among those that repeat none.
_RUN_SHARES = np.array([0.05, 0.5, 0.95])
_NEAR_SHARES = np.array([0.05, 0.5, 0.95])
_FAR_SHARES = np.array([0.01, 0.05, 0.2, 0.5])
_NEAR_MISS_QUANTILES = np.array([1.0, 3.0, 5.0]) / 6
# For a robot that stays upright: share of false closures wrong by a turn about the vertical, if there are such at all.
_ABOUT_VERTICAL = 0.9
# Prior probability that each run of false closures has its own shares of repeats.
_OWN_SHARES = 0.25
# A closure counts as predicted if the variance is less than this share of that of a uniform rotation.
_TOLD = 0.5
# Floor of a density; bounds beyond which a product is moved into its logarithm.
_LEAST, _SMALL, _LARGE = 1e-100, 1e-100, 1e100
# Units of work per closure that is evaluated.
_LOOKED_AT = 0.015


# All combinations of the shares of the run and of those shortly before.
_OF_RUN, _BEFORE = (share.reshape(-1, 1) for share in np.meshgrid(_RUN_SHARES, _NEAR_SHARES, indexing="ij"))


def _grid(kinds: int) -> tuple[int, ...]:
    """Shape of the grid of rates, for ``kinds`` densities of independently false closures."""
    return len(_RUN_SHARES), len(_NEAR_SHARES), len(_FAR_SHARES), kinds, KERNELS


def _split(rates: np.ndarray, kinds: int) -> tuple[np.ndarray, np.ndarray]:
    """Splits values ``(G,)`` into those with c and d shared by all runs, ``(9, …)``, and own to each, ``(1, …)``."""
    others = _grid(kinds)[2:]
    each = rates.reshape(len(_OF_RUN) + 1, *others)
    return each[:-1], each[-1:]


class Discrepancies(NamedTuple):
    """By what C closures differ from what predicts them.

    Attributes:
        residual: ``(C, 3)`` rad, from source to target.
        predicted: ``(C,)`` rad², variance of the predictions that residuals are counted from.
        closure_variance: rad² per component, of good closures.
    """

    residual: np.ndarray
    predicted: np.ndarray
    closure_variance: float

    @classmethod
    def of(cls, problem: Problem, state: State, residual: np.ndarray) -> Discrepancies:
        """Those of a labelling, from residuals ``(E, 3)`` of all edges."""
        closure = problem.closure
        return cls(residual[closure], state.others.predicted[closure], state.noise.closure_variance)

    @property
    def between_good(self) -> float:
        """Rad, standard deviation of the difference between two good closures of the same places."""
        return math.sqrt(2 * self.closure_variance)


@dataclass(frozen=True)
class FalseDensity:
    """Densities of n closures if they are false (not logarithms).

    The shares of repeats, c and d, are the same for all runs, or each run has its own: one place may be mistaken by the
    same turn as long as it is seen, another by many different turns. Of the grid's G points, those with shared c and d
    come first, then those where c and d are summed over run by run.

    Attributes:
        alone: ``(M, n)`` densities if independently false, for each share of near misses; repeated with most turns
            about the vertical, if there is one.
        repeats: densities given the turns of other closures, where there are such.
        run: ``(n,)`` number of each closure's run.
        log_kernel: ``(S,)`` log probability of each kernel, relative to equal ones.
    """

    alone: np.ndarray
    repeats: Repeats
    run: np.ndarray
    log_kernel: np.ndarray

    def log_sums(self) -> np.ndarray:
        """``(G,)`` log density of all closures jointly, at each point of the grid of rates.

        Each density is (1 − c) ((1 − d) ((1 − g) alone + g of any) + d of those before) + c of its run, where there are
        such.
        """
        order = np.argsort(self.run, kind="stable")
        return _log_sums(self.alone, *self.repeats, self.run, order, (_RUN_SHARES, _NEAR_SHARES, _FAR_SHARES))

    def mean(self, log_rates: np.ndarray, own: np.ndarray) -> np.ndarray:
        """``(n,)`` density of each closure, averaged over the grid.

        It is linear in the four densities, so their coefficients are summed over the grid beforehand.

        Args:
            log_rates: ``(G,)`` log probabilities of the grid's points.
            own: ``(9, n)`` probability of each c and d for a closure's run, if it has its own.
        """
        shared, _ = _split(np.exp(log_rates), len(self.alone))
        mean = self._summed(shared).sum(axis=0) + (self.by_shares(log_rates) * own).sum(axis=0)
        return np.asarray(np.maximum(mean, _LEAST))

    def by_shares(self, log_rates: np.ndarray) -> np.ndarray:
        """``(9, n)`` density of each, for each c and d, averaged over the points at which runs have their own."""
        _, own = _split(np.exp(log_rates), len(self.alone))
        return self._summed(own)

    def _summed(self, rates: np.ndarray) -> np.ndarray:
        """``(9, n)`` densities for each c and d, summed with weights ``rates`` ``(9 or 1, g, M, kernels)``."""
        of_kernels = rates.sum(axis=(1, 2))
        has_run, has_near, has_any = self.repeats.has_any
        of_run, before = of_kernels @ self.repeats.density[0], of_kernels @ self.repeats.density[1]
        any_one = rates.sum(axis=(1, 3)) @ self.alone
        repeated = np.tensordot(rates, _FAR_SHARES, (1, 0))
        far = repeated.sum(axis=1) @ self.repeats.density[2] - repeated.sum(axis=2) @ self.alone
        run = _OF_RUN * has_run
        near = (1 - run) * _BEFORE * has_near
        return np.asarray((1 - run - near) * (any_one + has_any * far) + near * before + run * of_run)


@compiled
def _log_sums(
    alone: np.ndarray,
    density: np.ndarray,
    has_any: np.ndarray,
    run: np.ndarray,
    order: np.ndarray,
    shares: tuple[np.ndarray, np.ndarray, np.ndarray],
) -> np.ndarray:
    """Logarithms of the products in :meth:`FalseDensity.log_sums`, taken whenever a product gets small."""
    of_run, before, of_any = shares
    kinds, kernels = len(alone), density.shape[1]
    ways, inner = len(of_run) * len(before), len(of_any) * kinds * kernels
    size = ways * inner
    # Products for the current run; then for all runs, with shared c and d and with their own.
    product, total = np.ones(size), np.zeros(size)
    at_rates = product.reshape(len(of_run), len(before), len(of_any), kinds, kernels)
    products, totals = np.ones(size + inner), np.zeros(size + inner)
    its, recent, others = np.empty(kernels), np.empty(kernels), np.empty(kernels)
    for place in range(len(order)):
        n = order[place]
        for s in range(kernels):
            its[s], recent[s], others[s] = density[0, s, n], density[1, s, n], density[2, s, n]
        is_out = False
        for c in range(len(of_run)):
            for d in range(len(before)):
                of_its = of_run[c] if has_any[0, n] else 0.0
                near = (1 - of_its) * (before[d] if has_any[1, n] else 0.0)
                rest = 1 - of_its - near
                for g in range(len(of_any)):
                    far = rest * (of_any[g] if has_any[2, n] else 0.0)
                    for m in range(kinds):
                        by_itself, row = (rest - far) * alone[m, n], at_rates[c, d, g, m]
                        # Without a branch several kernels are multiplied at once.
                        for s in range(kernels):
                            each = by_itself + far * others[s] + near * recent[s] + of_its * its[s]
                            row[s] *= max(each, _LEAST)
                            is_out |= not _SMALL < row[s] < _LARGE
        if is_out:
            _take_logarithms(product, total)
        if place + 1 < len(order) and run[order[place + 1]] == run[n]:
            continue
        _count_run(product, total, products, totals)
        product[:], total[:] = 1.0, 0.0
        _take_logarithms(products, totals)
    return np.asarray(totals + np.log(products))


@compiled
def _take_logarithms(product: np.ndarray, total: np.ndarray) -> None:
    """Move products ``(n,)`` that are about to leave the range of numbers into their logarithms' sums."""
    for at in range(len(product)):
        if not _SMALL < product[at] < _LARGE:
            total[at] += math.log(product[at])
            product[at] = 1.0


@compiled
def _count_run(product: np.ndarray, total: np.ndarray, products: np.ndarray, totals: np.ndarray) -> None:
    """Multiply the products of all runs by those of one; where c and d are its own, by the mean over these.

    Args:
        product, total: ``(ways · inner,)`` products of the run, and logarithms taken from them, 0 where none was.
        products, totals: ``(ways · inner + inner,)`` the same of all runs.
    """
    size = len(product)
    inner = len(products) - size
    ways, is_small = size // inner, False
    for at in range(size):
        is_small |= total[at] != 0.0
    for point in range(inner):
        summed = 0.0
        if is_small:
            largest = -math.inf
            for at in range(point, size, inner):
                total[at] += math.log(product[at])
                totals[at] += total[at]
                largest = max(largest, total[at])
            for at in range(point, size, inner):
                summed += math.exp(total[at] - largest)
            totals[size + point] += largest
        else:
            for at in range(point, size, inner):
                products[at] *= product[at]
                summed += product[at]
        products[size + point] *= summed / ways


def false_density(
    problem: Problem,
    is_false: np.ndarray,
    off: Discrepancies,
    rows: np.ndarray,
    both_sides: bool = False,
) -> FalseDensity:
    """Densities of closures that are false independently, or by the same turn of the world as other false ones.

    The density of a repeat is a kernel estimate over the false closures detected before (a Pólya urn); nearby ones are
    weighted separately (:mod:`~rotavg_ros.solver.slam.noise.repeats`).

    Args:
        problem: the graph.
        is_false: ``(C,)`` bool, labels of the others.
        off: of all closures.
        rows: ``(n,)`` closures to evaluate.
        both_sides: given all others, not only those detected before.
    """
    spend(_LOOKED_AT * len(rows))
    k, count = problem.components, len(rows)
    residual, predicted, _ = off
    square = (residual[rows] ** 2).sum(axis=1)
    near_misses = _near_miss_shares(problem.priors)[:, None]
    alone = np.exp(log_false(square, k, problem.priors, near_misses, predicted[rows]))
    if problem.vertical is not None:
        uniform = (1 - near_misses) * np.exp(log_uniform_density(np.sqrt(square), k))
        ratio = problem.vertical.density_ratio(residual[rows], predicted[rows])
        alone = np.concatenate((alone, alone + _ABOUT_VERTICAL * uniform * (ratio - 1)))
    run = problem.run[rows]
    log_width = log_widths(off.between_good, problem.priors.noise_spread)
    log_kernel = np.append(log_width + np.log(len(log_width)), 0.0)
    if count == 0 or not is_false.any() or "repeats" in problem.without:
        return FalseDensity(alone, Repeats.none(count), run, log_kernel)
    older, newer = problem.ends.T
    turn = np.ascontiguousarray(quaternion_rows.exp((residual * problem.sign[:, None]).T).T)
    # If nothing else predicts a closure, the turn by which it is wrong is unknown.
    is_told = predicted < _TOLD * anyhow(k)
    false = problem.detection[is_false[problem.detection]]
    is_one = is_false[rows] if both_sides else None
    between = places_near(problem.detected[false], problem.detected[rows], is_one)
    closures, near = Closures(older, newer, turn, is_told), Near(rows, false, between)
    repeated = repeats(closures, near, problem.priors.run_gap_steps, k, log_width)
    return FalseDensity(alone, repeated, run, log_kernel)


def _near_miss_shares(priors: SlamPriors) -> np.ndarray:
    """``(M,)`` equally likely shares under Beta(1, b), whose mean is the prior's share: 1 − (1 − u)^(1/b)."""
    mean = priors.near_miss_share
    return np.asarray(-np.expm1(mean / (1 - mean) * np.log1p(-_NEAR_MISS_QUANTILES)))


@cache
def _log_repeat_prior(priors: SlamPriors, kinds: int, has_own: bool) -> np.ndarray:
    """``(G,)`` log prior of the grid's points: Beta(1, count) for the share of repeats elsewhere, else uniform.

    That of kernels depends on the noise of closures and comes with the density.

    With probability :data:`_OWN_SHARES` each run has its own shares; otherwise all have the same.
    """
    far = (priors.elsewhere_count - 1) * np.log1p(-_FAR_SHARES) + np.log(np.gradient(_FAR_SHARES))
    shared = np.broadcast_to(far[:, None, None], _grid(kinds)).ravel()
    own = np.broadcast_to(far[:, None, None], _grid(kinds)[2:]).ravel()
    log_odds = np.log(_OWN_SHARES / (1 - _OWN_SHARES)) if has_own else -np.inf
    grid = np.concatenate((shared - np.logaddexp.reduce(shared), own - np.logaddexp.reduce(own) + log_odds))
    return np.asarray(grid - np.logaddexp.reduce(grid))


def _log_weighted(problem: Problem, density: FalseDensity) -> np.ndarray:
    """``(G,)`` log of the prior times the density of all false closures, at the grid's points."""
    prior = _log_repeat_prior(problem.priors, len(density.alone), "own-repeats" not in problem.without)
    return np.asarray(density.log_sums() + (prior.reshape(-1, KERNELS) + density.log_kernel).ravel())


def repeat_rates(problem: Problem, density: FalseDensity) -> np.ndarray:
    """``(G,)`` log posterior of the grid's points, given false closures."""
    rates = _log_weighted(problem, density)
    return np.asarray(rates - np.logaddexp.reduce(rates))


def log_false_set(problem: Problem, density: FalseDensity) -> float:
    """Log density of all false closures jointly, with rates and kernel width integrated."""
    return float(np.logaddexp.reduce(_log_weighted(problem, density)))


def if_false(problem: Problem, is_false: np.ndarray, off: Discrepancies) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` densities of each closure if it is false: given all other false ones, and independently.

    Args:
        problem: the graph.
        is_false: ``(C,)`` bool.
        off: of all closures.
    """
    rows = np.flatnonzero(is_false)
    false = false_density(problem, is_false, off, rows)
    each = false_density(problem, is_false, off, np.arange(len(is_false)), both_sides=True)
    rates = repeat_rates(problem, false)
    own = _own_shares(problem, rows, false.by_shares(rates))
    return each.mean(rates, own), each.alone.mean(axis=0)


def _own_shares(problem: Problem, rows: np.ndarray, by_shares: np.ndarray) -> np.ndarray:
    """``(9, C)`` probability of each c and d for each closure's run, given the other false closures.

    Args:
        problem: the graph.
        rows: ``(F,)`` false closures.
        by_shares: ``(9, F)`` their densities.
    """
    log = np.log(np.maximum(by_shares, _LEAST)).T
    of_run = np.zeros((int(problem.run.max(initial=-1)) + 1, log.shape[1]))
    np.add.at(of_run, problem.run[rows], log)
    own = of_run[problem.run]
    own[rows] -= log
    return np.asarray(softmax(own.T, axis=0))
