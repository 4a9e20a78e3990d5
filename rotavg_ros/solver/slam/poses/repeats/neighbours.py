"""What closures before and after a closure, and all others, say of whether it joins wrong places, and which."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.noise.repeats import Near
from rotavg_ros.solver.slam.poses.closures import GOOD, Told
from rotavg_ros.solver.slam.poses.priors import PlacePriors

# Squared widths of what repeats differ by, in those of two good closures: so many, each a sixteenth of the one before.
_BROADEST, _WIDTHS = 256.0, 3
# No share is less than this, or nearer to one; whoever is wrong with less than this chance tells nobody anything.
_SHARE = _LEAST_CHANCE = 0.01


@dataclass(frozen=True)
class Repeats:
    """Of C closures, what others say of the wrong places that each may join.

    Attributes:
        chance: ``(C,)`` that one before or after joins wrong places.
        alike: ``(C,)`` density of each one's turn and shift if it joins the places of such a one, seen nearly at the
            right angle, …
        turned: … and of its shift, given the turn, where not; each times the chances of these.
        has_elsewhere: ``(C,)`` how surely there is one anywhere that joins wrong places at nearly the right angle; …
        elsewhere: ``(C,)`` … and the density of turn and shift by these.
    """

    chance: np.ndarray
    alike: np.ndarray
    turned: np.ndarray
    has_elsewhere: np.ndarray
    elsewhere: np.ndarray


@dataclass(frozen=True)
class Errors:
    """By what C closures are off from what all else says, from their older to their newer ends.

    Attributes:
        turn, shift: ``(C, k)`` rad and ``(C, m)`` metres.
        turn_variance: ``(C,)`` rad² per component, of good ones.
        shift_variance: m² per component, of a good one.
        is_told: ``(C,)`` bool, whether all else says anything of it: if not, nobody knows by what it is off.
    """

    turn: np.ndarray
    shift: np.ndarray
    turn_variance: np.ndarray
    shift_variance: float
    is_told: np.ndarray

    def turned_alike(self, rows: np.ndarray, others: np.ndarray, sign: int = 1) -> np.ndarray:
        """``(P,)`` densities of turns, if they are ``sign`` times those of others."""
        variance = self.turn_variance[rows] + self.turn_variance[others]
        return _mean_kernels(self.turn[rows] - sign * self.turn[others], variance)

    def shifted_alike(self, rows: np.ndarray, others: np.ndarray, sign: int = 1) -> np.ndarray:
        """``(P,)`` densities of shifts, if they are ``sign`` times those of others."""
        variance = np.full(len(rows), 2 * self.shift_variance)
        return _mean_kernels(self.shift[rows] - sign * self.shift[others], variance)


def repeats_of(errors: Errors, before: np.ndarray, told: Told, *, in_order: bool) -> Repeats:
    """By the closures that follow each other, if both join the same wrong places; and by all wrong ones.

    A front end goes on finding a wrong place once it has, and finds it again on the next lap, or from there the other
    one. So a false closure costs once what makes its places alike: how they are turned, and where they are.

    Args:
        errors: of all closures.
        before: ``(J + 1, C)`` chances of classes.
        told: which follows which.
        in_order: of those before alone.
    """
    can_tell = told.is_known & errors.is_told
    later = np.flatnonzero((told.follows >= 0) & can_tell & can_tell[told.follows])
    earlier = told.follows[later]
    shifted = errors.shifted_alike(later, earlier)
    count = len(told.follows)
    ends = [(later, earlier)] if in_order else [(later, earlier), (earlier, later)]
    neighbours = np.maximum(sum(np.bincount(end, minlength=count) for end, _ in ends), 1)

    def mean_over(weight: np.ndarray, each: np.ndarray) -> np.ndarray:
        return np.asarray(sum(np.bincount(end, each * weight[other], count) for end, other in ends) / neighbours)

    alike, turned = before[GOOD:-1].sum(axis=0), before[-1]
    return Repeats(
        mean_over(alike + turned, np.ones(len(later))),
        mean_over(alike, errors.turned_alike(later, earlier) * shifted),
        mean_over(turned, shifted),
        *_elsewhere(errors, alike * can_tell, told, in_order=in_order),
    )


def _elsewhere(errors: Errors, wrong: np.ndarray, told: Told, *, in_order: bool) -> tuple[np.ndarray, np.ndarray]:
    """``has_elsewhere`` and ``elsewhere`` of :class:`Repeats`, by the chances ``(C,)`` to join wrong places."""
    tells = told.detection[wrong[told.detection] > _LEAST_CHANCE]
    rows = np.flatnonzero(told.is_known & errors.is_told)
    near = told.detected_near(rows, tells, in_order=in_order)
    off = np.concatenate((errors.turn, errors.shift), axis=1)
    variance = errors.turn_variance, errors.shift_variance
    density, total = _moved_alike(off, errors.turn.shape[1], *variance, wrong, near)
    return np.minimum(total, 1.0), density / np.maximum(total, 1.0)


@compiled
def _moved_alike(
    off: np.ndarray, turns: int, turn_variance: np.ndarray, shift_variance: float, wrong: np.ndarray, near: Near
) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` densities of turns and shifts like those of others near, or their opposites; and how many these are.

    A place that was mistaken for another one is so again, or from there the other one for it.

    Args:
        off: ``(C, k + m)`` turns and shifts.
        turns: k.
        turn_variance: ``(C,)`` rad² per component, of good closures' turns.
        shift_variance: m² per component.
        wrong: ``(C,)`` chances to join wrong places.
        near: which to compare with which.
    """
    rows, others, between = near
    shifts = off.shape[1] - turns
    density, total = np.zeros(len(wrong)), np.zeros(len(wrong))
    for n in range(len(rows)):
        row = rows[n]
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = others[place]
                moved = 0.0
                for sign in (1, -1):
                    of_turn, of_shift = 0.0, 0.0
                    for d in range(turns):
                        of_turn += (off[row, d] - sign * off[other, d]) ** 2
                    for d in range(turns, off.shape[1]):
                        of_shift += (off[row, d] - sign * off[other, d]) ** 2
                    shifted = _mean_kernel(of_shift, 2 * shift_variance, shifts)
                    if shifted > 0:
                        moved += shifted * _mean_kernel(of_turn, turn_variance[row] + turn_variance[other], turns)
                density[row] += wrong[other] * moved / 2
                total[row] += wrong[other]
    return density, total


@compiled
def _mean_kernel(square: float, variance: float, components: int) -> float:
    """Density of a difference of so many components, ``variance`` in each; mean of several widths."""
    half = components / 2
    kernel, total = math.exp(-square / (2 * _BROADEST * variance)), 0.0
    width = _BROADEST
    for _ in range(_WIDTHS):
        total += kernel / width**half
        # A sixteenth as wide: to the sixteenth power.
        for _ in range(4):
            kernel *= kernel
        width /= 16.0
    density: float = total / _WIDTHS / (2 * math.pi * variance) ** half
    return density


@compiled
def _mean_kernels(apart: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """``(P,)`` densities of differences ``(P, n)``, ``variance`` ``(P,)`` per component."""
    density = np.empty(len(apart))
    for p in range(len(apart)):
        density[p] = _mean_kernel((apart[p] ** 2).sum(), variance[p], apart.shape[1])
    return density


def wrong_share(before: np.ndarray, told: Told, priors: PlacePriors) -> np.ndarray:
    """``(C,)`` how likely each is to join wrong places, by all others and by its run most (Beta, Bernoulli)."""
    wrong, any_one = _wrong_places(before, told)
    overall = _overall(wrong, any_one, priors)
    in_run, of_run = np.bincount(told.run, wrong)[told.run] - wrong, np.bincount(told.run, any_one)[told.run] - any_one
    return np.asarray(np.clip((overall + in_run) / (1 + of_run), _SHARE, 1 - _SHARE))


def log_all_right(before: np.ndarray, told: Told, priors: PlacePriors, count: int) -> float:
    """Nats, that so many closures of a run all join right places, one after the other, by the same share."""
    right = 1 - _overall(*_wrong_places(before, told), priors)
    number = np.arange(count)
    return float(np.log((right + number) / (1 + number)).sum())


def _wrong_places(before: np.ndarray, told: Told) -> tuple[np.ndarray, np.ndarray]:
    """``(C,)`` each: chance of a wrong place, and of any that a closure can tell of."""
    return before[GOOD:-1].sum(axis=0) * told.is_known, (1 - before[-1]) * told.is_known


def _overall(wrong: np.ndarray, any_one: np.ndarray, priors: PlacePriors) -> float:
    return float((wrong.sum() + priors.wrong_place) / (any_one.sum() + priors.counted))
