"""Doubt in a solution that trusts the odometry: what speaks for slips, measured cheaply.

If odometry slipped, closures that their neighbours confirm are rejected, all that span the slip; or the slip passes for
drift, and the map explains closures that the odometry does not, or drifts farther than neighbouring closures see it
drift. All of this is cheap to measure, and a search for slips is not.
"""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from scipy.special import gammainc

from rotavg_ros.solver.slam.graph.agreement import AgreementPairs, closure_ends
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.model import NoiseModel, agree, noise_between_neighbours, pair_variance
from rotavg_ros.solver.slam.passes.alternation import SlamEstimate
from rotavg_ros.solver.slam.preparation import Prepared

# The solution is in strong doubt if this share of what at least so many neighbours agree upon is rejected by it (the
# second, where it rejects most closures: groups of false ones would have to be most, and lone ones do not agree),
_DOUBTED_SHARE = 0.53
_DOUBTED_SHARE_OF_MOST = 0.35
_MIN_SUPPORTERS = 2
# at a step if it rejects so many that neighbours confirm across one, and believes at most such a share of those across
# it: a false closure, or a group, is contradicted by good ones across the same steps, where there are some
_SPANNING, _BELIEVED_SHARE = 10, 0.05
# (as many neighbours would confirm one by chance less often than this),
_CHANCE = 0.05
# in some if it explains most closures, but so much larger a share disagrees with the odometry,
_MOST = 0.6
_DOUBTED_DIFFERENCE = 0.05
# or if more than this share is rejected and odometry drifts by so much more (in variance) than neighbours see; but they
# see nothing of drift below the last,
_NOTABLE_SHARE = 0.33
_DOUBTED_DRIFT = 3.5
_SEEN_DRIFT = np.radians(0.04) ** 2
# or if it drifts by this much more, while closures look so much better (in variance) than neighbours find them.
_DOUBTED_DRIFT_OF_EXACT = 2.0
_EXACT_CLOSURES = 0.15


class Doubt(IntEnum):
    """How much speaks for slips; at a step if that is where all closures speak against the odometry."""

    NONE = 0
    SOME = 1
    AT_A_STEP = 2
    STRONG = 3


def measure_doubt(prepared: Prepared, estimate: SlamEstimate) -> Doubt:
    """Doubt in ``estimate``."""
    graph, pairs, by_chain = prepared.closure_graph, prepared.pairs, prepared.noise
    if len(pairs.first) == 0:
        return Doubt.NONE
    rejected = estimate.inlier_probability[graph.is_closure] < 0.5
    supporters = np.bincount(pairs.first, agree(pairs, by_chain), len(rejected))
    # A group of false closures agrees with itself; it must not outvote the rest by its size.
    weight = np.where(supporters >= _MIN_SUPPORTERS, 1 / (1 + supporters), 0.0)
    expected = _supporters_by_chance(pairs, by_chain, len(rejected))
    rejected_weight, rejected_share = float((weight * rejected).sum()), float(rejected.mean())
    doubted_share = _DOUBTED_SHARE_OF_MOST if rejected_share > _MOST else _DOUBTED_SHARE
    if rejected_weight > doubted_share * weight.sum():
        by_chance = float(_weight_by_chance(expected)[rejected].sum())
        if rejected_weight - by_chance > doubted_share * (weight.sum() - by_chance):
            return Doubt.STRONG
    if rejected_share > _MOST:
        return Doubt.NONE
    # P(n ≥ m) for n ~ Poisson(λ)
    is_confirmed = gammainc(np.maximum(supporters, 1), expected) < _CHANCE
    if _has_contradicted_step(graph, rejected, is_confirmed & (supporters >= _MIN_SUPPORTERS)):
        return Doubt.AT_A_STEP
    explains_more = by_chain.outlier_share - rejected_share > _DOUBTED_DIFFERENCE
    if explains_more or (rejected_share > _NOTABLE_SHARE and _drifts_farther(pairs, estimate, by_chain)):
        return Doubt.SOME
    return Doubt.NONE


def _has_contradicted_step(graph: ClosureGraph, rejected: np.ndarray, is_confirmed: np.ndarray) -> bool:
    """Whether all that speaks of some step of the odometry speaks against it; closures ``(C,)`` bool each."""
    closure = np.flatnonzero(graph.is_closure)
    on_chain = np.isfinite(graph.path_steps[closure])
    at, ends = np.unique(closure_ends(graph, closure[on_chain]), return_inverse=True)
    first, last = ends.reshape(-1, 2).T

    def spanning(is_counted: np.ndarray) -> np.ndarray:
        """How many of the closures that are counted span what follows each end of a closure."""
        begin, end = (np.bincount(place, is_counted[on_chain], len(at)) for place in (first, last))
        return np.cumsum(begin - end)

    against = spanning(rejected & is_confirmed)
    return bool(((against >= _SPANNING) & (spanning(~rejected) <= _BELIEVED_SHARE * against)).any())


def _supporters_by_chance(pairs: AgreementPairs, noise: NoiseModel, num_closures: int) -> np.ndarray:
    """``(C,)`` how many neighbours agree with a closure on average if it and all of them are random."""
    k, variance = noise.components, pair_variance(pairs, noise)
    evidence = -k / 2 * np.log(2 * np.pi * variance) - log_uniform_density(np.zeros(1), k)
    angle = np.minimum(np.sqrt(2 * variance * np.maximum(evidence, 0)), np.pi)
    chance = angle / np.pi if k == 1 else (angle - np.sin(angle)) / np.pi
    return np.bincount(pairs.first, chance, num_closures)


def _weight_by_chance(expected: np.ndarray) -> np.ndarray:
    """``(C,)`` the weight that a closure has on average which so many neighbours confirm by chance."""
    # E[1 / (1 + n); n ≥ m] = P(n > m) / λ for n ~ Poisson(λ)
    return np.asarray(gammainc(1.0 + _MIN_SUPPORTERS, expected) / np.maximum(expected, 1e-12))


def _drifts_farther(pairs: AgreementPairs, estimate: SlamEstimate, by_chain: NoiseModel) -> bool:
    between = noise_between_neighbours(pairs, by_chain.components)
    drift = estimate.noise.step_variance / between.step_variance
    exact = by_chain.closure_variance < _EXACT_CLOSURES * between.closure_variance
    return (between.step_variance > _SEEN_DRIFT and drift > _DOUBTED_DRIFT) or (
        exact and drift > _DOUBTED_DRIFT_OF_EXACT
    )
