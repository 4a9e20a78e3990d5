"""Priors of labels: which closures are false, and where odometry slips, before residuals are considered."""

from __future__ import annotations

from functools import cache

import numpy as np
from scipy.special import betaln

from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem

# Grids that replace integrals over rates: the share of false closures; the probability that a label repeats that of an
# earlier closure; and how often that is the one detected last rather than the nearest of its run.
_SHARES = np.array([0.005, 0.02, 0.05, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98])
_STAY = np.array([0.0, 0.25, 0.5, 0.75, 0.9, 0.97])
_LAST_SHARES = np.array([0.0, 0.5, 1.0])


def _log_steps() -> np.ndarray:
    """``(G, 18)`` log P(label | before): over the grid of shares, of staying, and of whose label stays.

    A label is that of the nearest earlier closure of its run, that of the closure which was detected last, or drawn
    anew. Columns are numbered by :func:`_kind_of_step`.
    """
    grid = np.meshgrid(_SHARES, _STAY, _LAST_SHARES, indexing="ij")
    share, stay, last = (values.ravel() for values in grid)
    steps = np.empty((len(share), 3, 3, 2))
    for of_run, detected, label in np.ndindex(3, 3, 2):
        by_run, by_last = (1 - last) * stay * (of_run < 2), last * stay * (detected < 2)
        anew = (1 - by_run - by_last) * (share if label else 1 - share)
        steps[:, of_run, detected, label] = anew + by_run * (of_run == label) + by_last * (detected == label)
    return np.log(steps.reshape(len(share), -1))


_LOG_STEPS = _log_steps()
# Odd numbers whose sums with small weights differ: powers of a generator of pseudo-random ones, modulo 2⁶⁴ (Knuth).
_DIGITS = np.multiply.accumulate(np.full(_LOG_STEPS.shape[1], 6364136223846793005, dtype=np.int64))


@cache
def _log_grid_prior(priors: SlamPriors, without: frozenset[str]) -> np.ndarray:
    """``(G,)`` log prior of the grid's points: Beta for the shares, uniform for the rest unless switched off."""
    a = priors.outlier_share * priors.outlier_count
    b = (1 - priors.outlier_share) * priors.outlier_count
    log = (a - 1) * np.log(_SHARES) + (b - 1) * np.log1p(-_SHARES) + np.log(np.gradient(_SHARES))
    stay = np.where(("label-runs" in without) & (_STAY > 0), -np.inf, 0.0)
    last = np.where(("label-bursts" in without) & (_LAST_SHARES > 0), -np.inf, 0.0)
    log = (log[:, None, None] + stay[:, None] + last).ravel()
    return np.asarray(log - np.logaddexp.reduce(log))


def _log_prior(problem: Problem) -> np.ndarray:
    return _log_grid_prior(problem.priors, problem.without & {"label-runs", "label-bursts"})


def _kind_of_step(of_run: np.ndarray, detected: np.ndarray, label: np.ndarray) -> np.ndarray:
    """Column of ``_LOG_STEPS``, from the labels of the two earlier closures (2: there is none) and the own label."""
    return np.asarray((3 * of_run + detected) * 2 + label)


def _label_of(before: np.ndarray, label: np.ndarray) -> np.ndarray:
    """``(C,)`` label of the closure before each, or 2 if there is none."""
    return np.where(before >= 0, label[before], 2)


def log_label_prior(problem: Problem, is_false: np.ndarray) -> float:
    """Log prior of all labels: each repeats an earlier one or is drawn anew; the rates are integrated."""
    label = is_false.astype(np.int64)
    kind = _kind_of_step(_label_of(problem.follows, label), _label_of(problem.preceded, label), label)
    counts = np.bincount(kind, minlength=_LOG_STEPS.shape[1])
    told = problem.log_odds[problem.closure]
    finite = np.where(np.isfinite(told), told, 0.0)
    return float(np.logaddexp.reduce(_LOG_STEPS @ counts + _log_prior(problem)) - finite[is_false].sum())


def label_log_odds(problem: Problem, is_false: np.ndarray) -> np.ndarray:
    """``(C,)`` prior log-odds that each closure is good, given the labels of all others."""
    label = is_false.astype(np.int64)
    if len(label) == 0:
        return np.zeros(0)
    of_run, detected = _label_of(problem.follows, label), _label_of(problem.preceded, label)
    counts = np.bincount(_kind_of_step(of_run, detected, label), minlength=_LOG_STEPS.shape[1])
    log_rates = _log_prior(problem) + _LOG_STEPS @ counts
    changes = _steps_with(problem, label, 1 - label) - _steps_with(problem, label, label)
    # Closures with the same neighbours have the same odds; the changes of each are hashed to one number.
    _, first, which = np.unique(changes @ _DIGITS, return_index=True, return_inverse=True)
    with_other = np.logaddexp.reduce(log_rates[:, None] + _LOG_STEPS @ changes[first].T, axis=0)[which]
    gained = with_other - np.logaddexp.reduce(log_rates)
    return np.asarray(np.where(is_false, gained, -gained) + problem.log_odds[problem.closure])


def _steps_with(problem: Problem, label: np.ndarray, own: np.ndarray) -> np.ndarray:
    """``(C, 18)`` count of each kind of step among those to and from a closure, if its label were ``own``."""
    follows, preceded, kinds = problem.follows, problem.preceded, _LOG_STEPS.shape[1]
    of_run, detected = _label_of(follows, label), _label_of(preceded, label)
    # A step from a closure that is both counts once.
    is_both = follows == preceded
    by_run, by_last = np.flatnonzero(follows >= 0), np.flatnonzero((preceded >= 0) & ~is_both)
    also = np.where(is_both, own[follows], detected)
    steps = (
        (np.arange(len(label)), _kind_of_step(of_run, detected, own)),
        (follows[by_run], _kind_of_step(own[follows], also, label)[by_run]),
        (preceded[by_last], _kind_of_step(of_run, own[preceded], label)[by_last]),
    )
    places = np.concatenate([closure * kinds + kind for closure, kind in steps])
    return np.bincount(places, minlength=len(label) * kinds).reshape(-1, kinds)


def log_slip_prior(problem: Problem, slipped: np.ndarray) -> float:
    """Log prior of the set of slipped segments: Beta–binomial over all steps; a slip is in any step of its segment.

    The rate is integrated, so the first slip costs much and later ones less.

    Args:
        problem: the graph.
        slipped: edges that slipped.
    """
    priors, count, total = problem.priors, len(slipped), problem.total_steps
    prior = betaln(priors.slip_count + count, priors.slip_steps + total - count)
    steps = np.maximum(problem.graph.own_steps[slipped], 1.0)
    return float(prior - betaln(priors.slip_count, priors.slip_steps) + np.log(steps).sum())


def log_slip_odds(problem: Problem, steps: np.ndarray, slips: int | np.ndarray) -> np.ndarray:
    """Prior log-odds that segments of ``steps`` ``(n,)`` slipped, given that ``slips`` others have, one or ``(n,)``."""
    priors = problem.priors
    rate = (priors.slip_count + slips) / (priors.slip_steps + problem.total_steps)
    return np.asarray(np.log(rate * np.maximum(steps, 1.0)))
