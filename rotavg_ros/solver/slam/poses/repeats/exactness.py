"""How exactly closures repeat each other's wrong places: in one of a few ways, shared by all closures.

Some front ends mistake places to within centimetres, others to within metres; some runs of false closures stay where
they began, others drift. If each closure had its own way, each would pay anew for being exact, and a run of fifty false
ones would cost more than a bent map that they fit. So ways are shared: the probability of each follows from the
closures detected before (a Pólya urn).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.noise.repeats import Near

# Squared widths of what repeats differ by, in those of two good closures: so many, each a sixteenth of the one before.
_BROADEST, WIDTHS = 256.0, 3
# A kernel ends at so many widths, where it is 4e-6 of its height.
_FARTHEST = 5.0
# No density is less.
_LEAST = 1e-300
# A repeat differs by one of them from the closure before, or from the mean of all before that it follows.
WAYS = 2 * WIDTHS


class Errors(NamedTuple):
    """By what C closures are off from what all else says, from their older to their newer ends.

    Attributes:
        turn, shift: ``(C, k)`` rad and ``(C, m)`` metres.
        turn_variance: ``(C,)`` rad² per component, of good ones.
        shift_variance: ``(C,)`` m² per component, of a good one.
        is_told: ``(C,)`` bool, whether all else says anything of it: if not, nobody knows by what it is off.
    """

    turn: np.ndarray
    shift: np.ndarray
    turn_variance: np.ndarray
    shift_variance: np.ndarray
    is_told: np.ndarray


class Chains(NamedTuple):
    """Chains of C closures, each of which may repeat the one before.

    Attributes:
        order: ``(C,)`` closures as they were detected.
        follows: ``(C,)`` the closure before each, or -1.
        linked: ``(C,)`` chance that each repeats that one.
    """

    order: np.ndarray
    follows: np.ndarray
    linked: np.ndarray


class InTurn(NamedTuple):
    """C closures as they were detected.

    Attributes:
        order: ``(C,)`` closures, the first first.
        run: ``(C,)`` number of each one's run.
        by_those_before: whether those before alone tell, and not all others.
    """

    order: np.ndarray
    run: np.ndarray
    by_those_before: bool


@compiled
def shared_ways(kernels: np.ndarray, beforehand: np.ndarray, tells: np.ndarray, told: InTurn) -> np.ndarray:
    """``(C, W)`` how likely each way is to each closure.

    What all tell counts for one closure within a run.

    Args:
        kernels: ``(C, W)`` densities of each closure in each way; zeros of those that tell nothing.
        beforehand: ``(W,)`` of closures that are counted beforehand, in each way.
        tells: ``(C,)`` chances that each is one of those that the ways are of.
        told: by which others.
    """
    count, ways = kernels.shape
    number, in_run = beforehand.copy(), np.zeros((told.run.max() + 1 if count else 0, ways))
    own, likely = np.zeros((count, ways)), np.empty((count, ways))
    for c in told.order:
        run = told.run[c]
        likely[c] = (number / number.sum() + in_run[run]) / (1 + in_run[run].sum())
        each = likely[c] * kernels[c]
        if each.sum() > 0:
            own[c] = tells[c] * (each / each.sum())
            number += own[c]
            in_run[run] += own[c]
    if not told.by_those_before:
        for c in range(count):
            others, of_run = number - own[c], in_run[told.run[c]] - own[c]
            likely[c] = (others / others.sum() + of_run) / (1 + of_run.sum())
    return likely


@compiled
def kernels_along(off: np.ndarray, variance: np.ndarray, chains: Chains) -> tuple[np.ndarray, np.ndarray]:
    """``(C, W)`` densities in each way: of each closure by those that it follows, and of that one by those after it.

    Args:
        off: ``(C, n)`` what each is off by.
        variance: ``(C,)`` per component, of good ones.
        chains: which follow which; zeros where none is followed.
    """
    order, follows, linked = chains
    count = len(off)
    of_later, of_earlier = np.zeros((count, WAYS)), np.zeros((count, WAYS))
    # The mean of those of a run so far, and how many these are.
    mean, number = off.copy(), np.ones(count)
    for c in order:
        before = follows[c]
        if before >= 0:
            _fill(of_later[c], off[c], off[before], mean[before], (variance[c], variance[before], number[before]))
            number[c] += linked[c] * number[before]
            mean[c] += (number[c] - 1) / number[c] * (mean[before] - off[c])
    mean, number = off.copy(), np.ones(count)
    for c in order[::-1]:
        before = follows[c]
        if before >= 0:
            _fill(of_earlier[c], off[before], off[c], mean[c], (variance[before], variance[c], number[c]))
            further = linked[c] * number[c]
            number[before] += further
            mean[before] += further / number[before] * (mean[c] - mean[before])
    return of_later, of_earlier


@compiled
def repeated_anywhere(
    errors: Errors, alone: np.ndarray, wrong: np.ndarray, near: Near
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(C, W²)`` densities of turns and shifts like those of others near, or their opposites.

    And ``(C,)`` how many these others are, and how many of them are likely to be off alike.

    A place that was mistaken for another one is so again, or from there the other one for it. Densities are of each
    width of turns with each of shifts.

    Args:
        errors: of all closures.
        alone: ``(C,)`` density of turn and shift, if no other has to do with it.
        wrong: ``(C,)`` chances to join wrong places, seen nearly at the right angle.
        near: which to compare with which.
    """
    rows, others, between = near
    turns, shifts = errors.turn.shape[1], errors.shift.shape[1]
    density = np.zeros((len(wrong), WIDTHS * WIDTHS))
    total, alike = np.zeros(len(wrong)), np.zeros(len(wrong))
    turned, shifted = np.empty(WIDTHS), np.empty(WIDTHS)
    asks, tells = np.zeros(len(wrong), np.bool_), np.zeros(len(wrong), np.bool_)
    asks[rows], tells[others] = True, True
    # Whoever is compared with those after it, and tells as well as asks, is so with each of them both ways at once.
    both_ways = asks & tells & (between[:, 2] < between[:, 3]).any()
    for n in range(len(rows)):
        row = rows[n]
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = others[place]
                total[row] += wrong[other]
                is_both = both_ways[row] and both_ways[other]
                if is_both and side == 1:
                    continue
                of_turn = errors.turn_variance[row] + errors.turn_variance[other]
                of_shift = errors.shift_variance[row] + errors.shift_variance[other]
                for sign in (1, -1):
                    square = _apart(errors.shift[row], errors.shift[other], sign)
                    if square > _FARTHEST**2 * _BROADEST * of_shift:
                        continue
                    _kernels(shifted, square, of_shift, shifts)
                    square = _apart(errors.turn[row], errors.turn[other], sign)
                    if square > _FARTHEST**2 * _BROADEST * of_turn:
                        continue
                    _kernels(turned, square, of_turn, turns)
                    same = turned.mean() * shifted.mean()
                    for end in range(2 if is_both else 1):
                        one, another = (row, other) if end == 0 else (other, row)
                        alike[one] += wrong[another] * same / max(same + alone[one], _LEAST)
                        for of_turns in range(WIDTHS):
                            told = wrong[another] / 2 * turned[of_turns]
                            for of_shifts in range(WIDTHS):
                                density[one, of_turns * WIDTHS + of_shifts] += told * shifted[of_shifts]
    return density, total, alike


@compiled
def _fill(
    kernels: np.ndarray, off: np.ndarray, last: np.ndarray, mean: np.ndarray, noise: tuple[float, float, float]
) -> None:
    """``(W,)`` densities of one closure by the last one of a run and by the mean of so many.

    Args:
        kernels: to be filled, by the last one first, from the broadest on.
        off: ``(n,)`` of the closure.
        last, mean: ``(n,)`` of the others.
        noise: variances per component, of the one and of each of the others, and how many these are.
    """
    own, other, number = noise
    size = len(off)
    for way in range(2):
        square = _apart(off, last if way == 0 else mean, 1)
        variance = own + (other if way == 0 else other / number)
        _kernels(kernels[way * WIDTHS : (way + 1) * WIDTHS], square, variance, size)


@compiled
def _apart(off: np.ndarray, other: np.ndarray, sign: int) -> float:
    """Square of what one is off from another, or from its opposite."""
    square = 0.0
    for d in range(len(off)):
        square += (off[d] - sign * other[d]) ** 2
    return square


@compiled
def _kernels(kernels: np.ndarray, square: float, variance: float, components: int) -> None:
    """``(widths,)`` densities of a difference of so many components, ``variance`` in each, from the broadest on."""
    broadest = _BROADEST * variance
    kernel, root = math.exp(-square / (2 * broadest)), math.sqrt(2 * math.pi * broadest)
    height, higher = 1.0, 1.0
    for _ in range(components):
        height /= root
        higher *= 4.0
    for width in range(WIDTHS):
        kernels[width] = kernel * height
        height *= higher
        # A sixteenth as wide: to the sixteenth power.
        for _ in range(4):
            kernel *= kernel
