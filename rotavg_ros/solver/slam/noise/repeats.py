"""The density of other false closures at the turn of each: kernel estimates over those detected before, or all.

Places that look alike are mistaken for each other repeatedly. There are separate estimates for closures of the same
run, for those detected shortly before, and for all, since a run that begins need not repeat the turn of the last one.
Within a run, a place that was mistaken for another one is mistaken again; seen from the other place, by the inverse
turn.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# Widths of the kernels: standard deviations of the difference between repeats, degrees.
REPEAT_DEG = 0.05 * 2.0 ** np.arange(9)
# Kernels: either of one of the widths for all closures, or of all widths, drawn for each closure.
KERNELS = len(REPEAT_DEG) + 1
# Estimates: over the run, over those detected shortly before, over all.
_WHOSE = 3
# A kernel is cut off at this many widths, where it is 4e-6 of its height.
_FARTHEST = 5.0
# Number of closures detected before (and after) one with which it is compared.
_WINDOW = 48


class Closures(NamedTuple):
    """C closures.

    Attributes:
        older, newer: ``(C,)`` ends, in steps along the odometry.
        turn: ``(C, 4)`` rotation of the world by which each is wrong if it is false, from its older to its newer end.
        is_told: ``(C,)`` bool, whether anything else predicts that turn.
    """

    older: np.ndarray
    newer: np.ndarray
    turn: np.ndarray
    is_told: np.ndarray


class Near(NamedTuple):
    """Which closures are compared with which.

    Attributes:
        rows: ``(n,)`` the closures.
        others: ``(F,)`` those that they may be compared with, in the order of their detection.
        between: ``(n, 4)`` two ranges of these for each: from the first number to before the second, and from the third
            to before the fourth.
    """

    rows: np.ndarray
    others: np.ndarray
    between: np.ndarray


class Repeats(NamedTuple):
    """Estimates for n closures.

    Attributes:
        density: ``(3, S, n)`` density of each turn with each kernel, among those of its run, among false closures that
            were detected shortly before or join the same places, and among all.
        has_any: ``(3, n)`` bool, whether there are such closures.
    """

    density: np.ndarray
    has_any: np.ndarray

    @classmethod
    def none(cls, count: int) -> Repeats:
        """For n closures that are compared with no others."""
        return cls(np.zeros((_WHOSE, KERNELS, count)), np.zeros((_WHOSE, count), dtype=np.bool_))


def log_widths(usual: float, spread: float) -> np.ndarray:
    """``(S − 1,)`` log probabilities of the kernels' widths.

    What is mistaken again is measured again, so false closures that repeat each other agree about as well as good ones
    do. How much better is as uncertain as any noise is: log-normal. Without this, right closures are false that all
    contradict odometry by exactly the same turn. How much worse depends on the places: all such widths are equally
    likely.

    Args:
        usual: rad, standard deviation of the difference between two good closures of the same places.
        spread: standard deviation of the logarithm of a noise.
    """
    log = -((np.minimum(np.log(np.radians(REPEAT_DEG) / usual), 0.0) / spread) ** 2) / 2
    return np.asarray(log - np.logaddexp.reduce(log))


def repeats(closures: Closures, near: Near, gap: float, components: int, log_width: np.ndarray) -> Repeats:
    """Estimates for some closures.

    Args:
        closures: all closures.
        near: n of them, and the false ones that they are compared with.
        gap: steps; ends at most this far apart are near each other.
        components: k.
        log_width: ``(S − 1,)`` log probabilities of widths that are drawn for each closure.
    """
    density, total = _repeats(closures, near, gap, _Kernels.of(components), np.exp(log_width))
    return Repeats(density, total > 0)


class _Kernels(NamedTuple):
    """Normal densities.

    Attributes:
        height: ``(S − 1,)`` of each at zero difference.
        broadest: rad, standard deviation of the last.
        least_cosine: cosine of half the angle at which the last is cut off.
    """

    height: np.ndarray
    broadest: float
    least_cosine: float

    @classmethod
    def of(cls, components: int) -> _Kernels:
        width = np.radians(REPEAT_DEG)
        height = (2 * np.pi * width**2) ** (-components / 2)
        return cls(height, float(width[-1]), float(np.cos(_FARTHEST * width[-1] / 2)))


def places_near(when: np.ndarray, asked: np.ndarray, is_one: np.ndarray | None, window: int = _WINDOW) -> np.ndarray:
    """``(n, 4)`` ranges of closures detected shortly before and after each of some others: begin and end of both.

    Args:
        when: ``(F,)`` when the closures were detected, ascending.
        asked: ``(n,)`` when the others were detected.
        is_one: ``(n,)`` bool, which of the others are themselves among the closures, to exclude them; None: consider
            only closures detected before.
        window: largest number before, and after; a term of F has the default.
    """
    earlier = np.searchsorted(when, asked)
    later = np.full_like(earlier, len(when)) if is_one is None else earlier + is_one
    ends = np.maximum(earlier - window, 0), earlier, later, np.minimum(later + window, len(when))
    return np.stack(ends, axis=1)


@compiled
def _repeats(
    closures: Closures, compared: Near, gap: float, kernels: _Kernels, share: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    older, newer, turn, is_told = closures
    rows, false, between = compared
    height, least_cosine = kernels.height, kernels.least_cosine
    widths, broadest = len(height), -0.5 / kernels.broadest**2
    density, total = np.zeros((_WHOSE, widths + 1, len(rows))), np.zeros((_WHOSE, len(rows)))
    weight, of_one, summed = np.empty(_WHOSE), np.empty(widths), np.empty((_WHOSE, widths))
    for n in range(len(rows)):
        c = rows[n]
        if not is_told[c]:
            continue
        summed[:] = 0.0
        # Whether one was detected shortly before.
        follows = False
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = false[place]
                follows |= is_told[other] and abs(newer[other] - newer[c]) <= gap
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = false[place]
                if not is_told[other]:
                    continue
                by_older, by_newer = abs(older[other] - older[c]), abs(newer[other] - newer[c])
                crossed = min(abs(newer[other] - older[c]), abs(older[other] - newer[c]))
                is_inverse = crossed <= gap and by_older > gap and by_newer > gap
                is_of_run = by_older + by_newer <= gap
                is_of_places = follows and (is_inverse or by_older <= gap)
                weight[0] = 1.0 if is_of_run else 0.0
                weight[1] = 1.0 if (by_newer <= gap or is_of_places) and not is_of_run else 0.0
                weight[2] = 1.0
                for whose in range(_WHOSE):
                    total[whose, n] += weight[whose]
                axis = turn[other, 0] * turn[c, 0] + turn[other, 1] * turn[c, 1] + turn[other, 2] * turn[c, 2]
                real = turn[other, 3] * turn[c, 3]
                cosine = abs(real - axis if is_inverse else real + axis)
                if cosine <= least_cosine:
                    continue
                kernel = math.exp(broadest * (2 * math.acos(min(cosine, 1.0))) ** 2)
                for s in range(widths - 1, -1, -1):
                    of_one[s] = kernel
                    kernel = (kernel * kernel) ** 2  # half as wide: the fourth power
                for whose in range(_WHOSE):
                    if weight[whose] > 0:
                        for s in range(widths):
                            summed[whose, s] += weight[whose] * of_one[s]
        for whose in range(_WHOSE):
            for s in range(widths):
                density[whose, s, n] = summed[whose, s] * height[s] / max(total[whose, n], 1.0)
                density[whose, widths, n] += density[whose, s, n] * share[s]
    return density, total
