"""Evidence from the closures before and after a closure, and from all others, about whether it joins wrong places."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import expit, logit

from rotavg_ros.solver.slam.poses.closures import GOOD, REPEATS, Told
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.poses.repeats.exactness import (
    WIDTHS,
    Chains,
    Errors,
    InTurn,
    kernels_along,
    repeated_anywhere,
    shared_ways,
)
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns

# Least distance of shares from zero and one; and probability of being wrong below which a closure is no evidence.
_SHARE = _LEAST_CHANCE = 0.01
# Least share of tails, and steps by which it is found.
_FEWEST, _TAIL_STEPS = 1e-3, 20


@dataclass(frozen=True)
class Repeats:
    """Evidence from others about the wrong places that each of C closures may join.

    Attributes:
        has_alike: ``(C,)`` probability that one before or after joins wrong places, seen nearly at the right angle.
        alike: ``(C,)`` density of each one's turn and shift if it joins the same places, times that probability.
        has_turned: ``(C,)`` probability that one before or after joins wrong places by a false rotation.
        turned: ``(C, W)`` densities of its shift, given the turn, if it joins the same places, times that probability.
        has_elsewhere: ``(C,)`` expected number, at most 1, of others that join wrong places at nearly the right angle.
        elsewhere: ``(C, W)`` densities of turn and shift by these, times that number.
        number: ``(C,)`` expected number of closures, it included, that are off by about the same.
    """

    has_alike: np.ndarray
    alike: np.ndarray
    has_turned: np.ndarray
    turned: np.ndarray
    has_elsewhere: np.ndarray
    elsewhere: np.ndarray
    number: np.ndarray

    @property
    def has_any(self) -> np.ndarray:
        """``(C,)`` probability that a closure before or after joins wrong places."""
        return np.asarray(self.has_alike + self.has_turned)


def repeats_of(
    errors: Errors, maps: MapTurns, before: np.ndarray, told: Told, alone: np.ndarray, *, in_order: bool
) -> Repeats:
    """Evidence from closures that follow each other, if both join the same wrong places; and from all wrong ones.

    A front end that has found a wrong place continues to find it. It finds it again on the next lap, or finds the first
    place from the wrong one. So false closures pay only once for what makes two places look alike: their relative
    rotation and position.

    Args:
        errors: of all closures.
        maps: the turns of the map by which they are off.
        before: ``(J + 1, C)`` probabilities of classes.
        told: which follows which.
        alone: ``(C,)`` density of turn and shift at a wrong place that is seen nearly at the right angle, without any
            relation to another closure; zero: not compared with closures elsewhere.
        in_order: whether only closures detected before are evidence.
    """
    can_tell = told.is_known & errors.is_told
    alike, turned = before[GOOD:-1].sum(axis=0), before[-1]
    pairs = _Pairs.of(np.where(can_tell & can_tell[told.follows], told.follows, -1), in_order=in_order)
    linked = np.zeros(len(alike))
    linked[pairs.later] = before[REPEATS, pairs.later] * alike[pairs.earlier]
    in_turn = InTurn(told.detection, told.run, in_order)
    kinds = (errors.turn, errors.turn_variance), (errors.shift, errors.own_variance)
    of_turns, of_shifts = (_Exactness.of(off, variance, pairs, linked, in_turn) for off, variance in kinds)
    moved = [turn * shift for turn, shift in zip(of_turns.density, of_shifts.density, strict=True)]
    tells = told.detection[(alike * can_tell)[told.detection] > _LEAST_CHANCE]
    near = told.detected_near(np.flatnonzero(can_tell & (alone > 0)), tells, in_order=in_order)
    density, total, number = repeated_anywhere(errors, alone, alike, near)
    # False rotations are off by the same shift, or by the same turn of the map.
    ways = np.concatenate((np.stack([of_shifts.by_last] * 2), maps.repeats_after(pairs.later, pairs.earlier)), axis=2)
    certain = np.ones((2, len(pairs.later)))
    return Repeats(
        pairs.mean_over(alike, certain),
        pairs.mean_over(alike, moved),
        pairs.mean_over(turned, certain),
        np.stack([pairs.mean_over(turned, way) for way in np.moveaxis(ways, 2, 0)], axis=1),
        np.minimum(total, 1.0),
        density / np.maximum(total, 1.0)[:, None],
        1 + number,
    )


class _Pairs(NamedTuple):
    """P pairs of closures, where one follows the other.

    Attributes:
        later, earlier: ``(P,)`` closures.
        follows: ``(C,)`` the one before each, or -1.
        ends: pairs of arrays: the closures that get evidence, and those that it comes from. Later from earlier ones,
            and unless only closures before are evidence, also the other way round.
    """

    later: np.ndarray
    earlier: np.ndarray
    follows: np.ndarray
    ends: tuple[tuple[np.ndarray, np.ndarray], ...]

    @classmethod
    def of(cls, follows: np.ndarray, *, in_order: bool) -> _Pairs:
        later = np.flatnonzero(follows >= 0)
        earlier = follows[later]
        return cls(later, earlier, follows, ((later, earlier), (earlier, later))[: 1 if in_order else 2])

    def mean_over(self, weight: np.ndarray, each: Sequence[np.ndarray] | np.ndarray) -> np.ndarray:
        """``(C,)`` mean over neighbours of weight times value; values ``(P,)`` are given for each end of the pairs."""
        count = len(self.follows)
        neighbours = sum(np.bincount(end, minlength=count) for end, _ in self.ends)
        summed = (
            np.bincount(end, of * weight[other], count) for of, (end, other) in zip(each, self.ends, strict=False)
        )
        return np.asarray(sum(summed) / np.maximum(neighbours, 1))


class _Exactness(NamedTuple):
    """Densities of turns, or of shifts, of C closures in P pairs.

    Attributes:
        density: ``(P,)`` for each end of a pair, if it repeats the other.
        by_last: ``(P, widths)`` of either end, given only the other.
    """

    density: list[np.ndarray]
    by_last: np.ndarray

    @classmethod
    def of(
        cls, off: np.ndarray, variance: np.ndarray, pairs: _Pairs, linked: np.ndarray, in_turn: InTurn
    ) -> _Exactness:
        kernels = kernels_along(off, variance, Chains(in_turn.order, pairs.follows, linked))
        beforehand = np.ones(kernels[0].shape[1])
        likely = shared_ways(kernels[0], beforehand, linked, in_turn)
        of_ends = zip(kernels, pairs.ends, strict=False)
        density = [(likely[end] * of[pairs.later]).sum(axis=1) for of, (end, _) in of_ends]
        return cls(density, kernels[0][pairs.later, :WIDTHS])


def wrong_share(before: np.ndarray, told: Told, priors: PlacePriors) -> np.ndarray:
    """``(C,)`` probability that each joins wrong places, by all others and mostly by its run (Beta–Bernoulli)."""
    wrong, any_one = _wrong_places(before, told)
    overall = _overall(wrong, any_one, priors)
    in_run, of_run = np.bincount(told.run, wrong)[told.run] - wrong, np.bincount(told.run, any_one)[told.run] - any_one
    return np.asarray(np.clip((overall + in_run) / (1 + of_run), _SHARE, 1 - _SHARE))


def tail_share(log_ratio: np.ndarray, before: np.ndarray, told: Told, priors: PlacePriors) -> np.ndarray:
    """``(C,)`` probability that each, if good, is in the tails, by all others (Beta–Bernoulli); at most the prior's.

    By EM from that share, anew for all densities, so that a share that has once vanished comes back. If most could be
    in the tails, these could be taken for what is usual, and a smaller variance for what is rare.

    Args:
        log_ratio: ``(C,)`` nats, log density of each closure's shift in the tails minus that of other good ones.
        before: ``(J + 1, C)`` probabilities of classes.
        told: whose translations are known.
        priors: of places.
    """
    good = before[:GOOD].sum(axis=0) * told.is_known
    counted, share = good.sum() + priors.counted, priors.tails
    for _ in range(_TAIL_STEPS):
        tails = good * expit(log_ratio + logit(share))
        share = (priors.tails * priors.counted + tails.sum()) / counted
    others = (share * counted - tails) / (counted - good)
    return np.asarray(np.clip(others, _FEWEST, priors.tails))


def log_places(before: np.ndarray, told: Told, priors: PlacePriors) -> float:
    """Log probability, nats, of which closures join wrong places, each by the share of wrong ones among the others.

    Args:
        before: ``(J + 1, C)`` probabilities of classes.
        told: runs.
        priors: of places.
    """
    share, (wrong, any_one) = wrong_share(before, told, priors), _wrong_places(before, told)
    return float((wrong * np.log(share) + (any_one - wrong) * np.log1p(-share)).sum())


def log_all_right(before: np.ndarray, told: Told, priors: PlacePriors, count: int) -> float:
    """Log probability, nats, that ``count`` closures of a run all join right places, in turn, by the same share."""
    right = 1 - _overall(*_wrong_places(before, told), priors)
    number = np.arange(count)
    return float(np.log((right + number) / (1 + number)).sum())


def _wrong_places(before: np.ndarray, told: Told) -> tuple[np.ndarray, np.ndarray]:
    """Two arrays ``(C,)``: probability of a wrong place, and of any place that a closure can be evidence of."""
    return before[GOOD:-1].sum(axis=0) * told.is_known, (1 - before[-1]) * told.is_known


def _overall(wrong: np.ndarray, any_one: np.ndarray, priors: PlacePriors) -> float:
    return float((wrong.sum() + priors.wrong_place) / (any_one.sum() + priors.counted))
