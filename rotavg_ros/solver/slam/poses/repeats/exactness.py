"""How exactly closures repeat each other's wrong places: in one of a few ways, shared by all closures.

Some front ends repeat a wrong place to within centimetres, others to within metres. Some runs of false closures stay
where they began, others drift. If each closure had its own way, each would pay separately for being exact, and a run of
fifty false ones would cost more than a bent map that fits them. So ways are shared: the probability of each follows
from the closures detected before (a Pólya urn).
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.slam.noise.repeats import Near

# Variances of the difference between repeats, relative to that between two good closures: the largest, and how many.
# Each is a sixteenth of the one before.
_BROADEST, WIDTHS = 256.0, 3
# A kernel is cut off at this many widths, where it is 4e-6 of its height.
_FARTHEST = 5.0
# Lower bound of a density.
_LEAST = 1e-300
# A repeat differs by one of these widths from the closure before, or from the mean of all before in its chain.
WAYS = 2 * WIDTHS


class Errors(NamedTuple):
    """Errors of C closures relative to the prediction by all else, from their older to their newer ends.

    Attributes:
        turn, shift: ``(C, k)`` rad and ``(C, m)`` metres.
        turn_variance: ``(C,)`` rad² per component, of a good closure.
        shift_variance: ``(C,)`` m² per component, of a good closure.
        own_variance: ``(C,)`` m², the part of it that closures of a run do not share.
        is_told: ``(C,)`` bool, whether all else predicts it; if not, its error is unknown.
    """

    turn: np.ndarray
    shift: np.ndarray
    turn_variance: np.ndarray
    shift_variance: np.ndarray
    own_variance: np.ndarray
    is_told: np.ndarray


class Chains(NamedTuple):
    """Chains of C closures, each of which may repeat the one before.

    Attributes:
        order: ``(C,)`` closures in the order of detection.
        follows: ``(C,)`` the closure before each, or -1.
        linked: ``(C,)`` probability that each repeats that one.
    """

    order: np.ndarray
    follows: np.ndarray
    linked: np.ndarray


class InTurn(NamedTuple):
    """C closures in the order of detection.

    Attributes:
        order: ``(C,)`` closures, the first detected first.
        run: ``(C,)`` number of each one's run.
        by_those_before: whether only those before are evidence, instead of all others.
    """

    order: np.ndarray
    run: np.ndarray
    by_those_before: bool


@compiled
def shared_ways(kernels: np.ndarray, beforehand: np.ndarray, tells: np.ndarray, told: InTurn) -> np.ndarray:
    """``(C, W)`` probability of each way for each closure.

    Within a run, the evidence of all closures together counts as one closure.

    Args:
        kernels: ``(C, W)`` density of each closure in each way; zeros for those that are no evidence.
        beforehand: ``(W,)`` prior counts of closures, per way.
        tells: ``(C,)`` probability that each is a repeat.
        told: which others are evidence.
    """
    count, ways = kernels.shape
    num_runs = 0
    for c in range(count):
        num_runs = max(num_runs, told.run[c] + 1)
    number, in_run = np.empty(ways), np.zeros((num_runs, ways))
    for way in range(ways):
        number[way] = beforehand[way]
    own, likely, each = np.zeros((count, ways)), np.empty((count, ways)), np.empty(ways)
    for c in told.order:
        of_run = in_run[told.run[c]]
        _fill_shares(number, of_run, likely[c])
        total = 0.0
        for way in range(ways):
            each[way] = likely[c, way] * kernels[c, way]
            total += each[way]
        if total > 0:
            for way in range(ways):
                own[c, way] = tells[c] * (each[way] / total)
                number[way] += own[c, way]
                of_run[way] += own[c, way]
    if not told.by_those_before:
        others, of_others = np.empty(ways), np.empty(ways)
        for c in range(count):
            for way in range(ways):
                others[way], of_others[way] = number[way] - own[c, way], in_run[told.run[c], way] - own[c, way]
            _fill_shares(others, of_others, likely[c])
    return likely


@compiled
def _fill_shares(number: np.ndarray, of_run: np.ndarray, share: np.ndarray) -> None:
    """``(W,)`` probability of each way, given the number of closures anywhere and in the run, which count as one."""
    total, of_run_total = 0.0, 0.0
    for way in range(len(share)):
        total += number[way]
        of_run_total += of_run[way]
    for way in range(len(share)):
        share[way] = (number[way] / total + of_run[way]) / (1 + of_run_total)


@compiled
def kernels_along(off: np.ndarray, variance: np.ndarray, chains: Chains) -> tuple[np.ndarray, np.ndarray]:
    """``(C, W)`` densities per way: of each closure by those that it follows, and of the one before by those after.

    Densities are zero where a closure follows none.

    Args:
        off: ``(C, n)`` error of each.
        variance: ``(C,)`` per component, of a good closure.
        chains: which follow which.
    """
    order, follows, linked = chains
    count, size = off.shape
    of_later, of_earlier = np.zeros((count, WAYS)), np.zeros((count, WAYS))
    # The mean of each chain so far, and the number of its closures.
    mean, number = off.copy(), np.ones(count)
    for c in order:
        before = follows[c]
        if before >= 0:
            _fill(of_later[c], off[c], off[before], mean[before], (variance[c], variance[before], number[before]))
            number[c] += linked[c] * number[before]
            for d in range(size):
                mean[c, d] += (number[c] - 1) / number[c] * (mean[before, d] - off[c, d])
    mean, number = off.copy(), np.ones(count)
    for place in range(len(order) - 1, -1, -1):
        c = order[place]
        before = follows[c]
        if before >= 0:
            _fill(of_earlier[c], off[before], off[c], mean[c], (variance[before], variance[c], number[c]))
            further = linked[c] * number[c]
            number[before] += further
            for d in range(size):
                mean[before, d] += further / number[before] * (mean[c, d] - mean[before, d])
    return of_later, of_earlier


@compiled
def repeated_anywhere(
    errors: Errors, alone: np.ndarray, wrong: np.ndarray, near: Near
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """``(C, W²)`` densities of turns and shifts, from the errors of others near, or their opposites.

    And, ``(C,)`` each, the expected numbers of these others, and of those that are off alike.

    A place that was mistaken for another one is mistaken again; seen from the other place, the error is opposite. There
    is a density for each pair of a width of turns and a width of shifts.

    Args:
        errors: of all closures.
        alone: ``(C,)`` density of turn and shift, without any relation to another closure.
        wrong: ``(C,)`` probability of joining wrong places, seen nearly at the right angle.
        near: which to compare with which.
    """
    rows, others, between = near
    turns, shifts = errors.turn.shape[1], errors.shift.shape[1]
    density = np.zeros((len(wrong), WIDTHS * WIDTHS))
    total, alike = np.zeros(len(wrong)), np.zeros(len(wrong))
    turned, shifted = np.empty(WIDTHS), np.empty(WIDTHS)
    asks, tells = np.zeros(len(wrong), np.bool_), np.zeros(len(wrong), np.bool_)
    has_later = False
    for n in range(len(rows)):
        asks[rows[n]] = True
        has_later |= between[n, 2] < between[n, 3]
    for place in range(len(others)):
        tells[others[place]] = True
    for n in range(len(rows)):
        row = rows[n]
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = others[place]
                total[row] += wrong[other]
                # Closures on both sides are compared with those after them in both directions at once.
                is_both = has_later and tells[row] and asks[other]
                if is_both and side == 1:
                    continue
                of_turn = errors.turn_variance[row] + errors.turn_variance[other]
                of_shift = errors.shift_variance[row] + errors.shift_variance[other]
                for sign in (1.0, -1.0):
                    square = _apart(errors.shift[row], errors.shift[other], sign)
                    if square > _FARTHEST**2 * _BROADEST * of_shift:
                        continue
                    _kernels(shifted, square, of_shift, shifts)
                    square = _apart(errors.turn[row], errors.turn[other], sign)
                    if square > _FARTHEST**2 * _BROADEST * of_turn:
                        continue
                    _kernels(turned, square, of_turn, turns)
                    same = mean(turned) * mean(shifted)
                    for end in range(2 if is_both else 1):
                        one, another = (row, other) if end == 0 else (other, row)
                        alike[one] += wrong[another] * same / max(same + alone[one], _LEAST)
                        for i in range(WIDTHS):
                            told = wrong[another] / 2 * turned[i]
                            for j in range(WIDTHS):
                                density[one, i * WIDTHS + j] += told * shifted[j]
    return density, total, alike


@compiled
def mean(values: np.ndarray) -> float:
    """The mean of a few values."""
    total = 0.0
    for value in values:
        total += value
    return total / len(values)


@compiled
def _fill(
    kernels: np.ndarray, off: np.ndarray, last: np.ndarray, mean: np.ndarray, noise: tuple[float, float, float]
) -> None:
    """``(W,)`` densities of one closure given the last one of its chain, and given the mean of the chain.

    Args:
        kernels: to be filled; those given the last one come first, the broadest first.
        off: ``(n,)`` error of the closure.
        last, mean: ``(n,)`` errors of the others.
        noise: variance per component of the closure and of each of the others, and the number of the others.
    """
    own, other, number = noise
    size = len(off)
    for way in range(2):
        square = _apart(off, last if way == 0 else mean, 1.0)
        variance = own + (other if way == 0 else other / number)
        _kernels(kernels[way * WIDTHS : (way + 1) * WIDTHS], square, variance, size)


@compiled
def _apart(off: np.ndarray, other: np.ndarray, sign: float) -> float:
    """Squared distance of one error from another one (``sign`` 1), or from its opposite (-1)."""
    square = 0.0
    for d in range(len(off)):
        square += (off[d] - sign * other[d]) ** 2
    return square


@compiled
def _kernels(kernels: np.ndarray, square: float, variance: float, components: int) -> None:
    """Fill ``(widths,)`` densities of a difference, given ``variance`` per component, the broadest first."""
    broadest = _BROADEST * variance
    kernel, root = math.exp(-square / (2 * broadest)), math.sqrt(2 * math.pi * broadest)
    height, higher = 1.0, 1.0
    for _ in range(components):
        height /= root
        higher *= 4.0
    for width in range(WIDTHS):
        kernels[width] = kernel * height
        height *= higher
        # A sixteenth of the variance: the sixteenth power.
        for _ in range(4):
            kernel *= kernel
