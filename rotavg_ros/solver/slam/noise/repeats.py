"""How dense other false closures lie about the turn of each: kernel estimates over those detected before, or all.

Places that look alike are mistaken for each other again and again. Those near a closure weigh apart from all: those
detected shortly before, most of them those of the same run, and, where there are such, those that join the same places.
A place that was mistaken for another one is so again; from there, the other one for it, by the inverse turn.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# What repeats differ by, as a kernel's width.
REPEAT_DEG = 0.05 * 2.0 ** np.arange(9)
# One width for all, or each as likely for every closure.
KERNELS = len(REPEAT_DEG) + 1
# Of closures that are near, one that was detected at about the same time from about the same older place counts for so
# many others.
_IN_RUN = 10.0
# A kernel ends at so many widths, where it is 4e-6 of its height.
_FARTHEST = 5.0


class Closures(NamedTuple):
    """C closures.

    Attributes:
        older, newer: ``(C,)`` ends, in steps along the odometry.
        turn: ``(C, 4)`` of the world, by which each is wrong if it is false, from its older to its newer end.
        is_told: ``(C,)`` bool, whether anything else tells that turn.
    """

    older: np.ndarray
    newer: np.ndarray
    turn: np.ndarray
    is_told: np.ndarray


class Near(NamedTuple):
    """What some closures are compared with.

    Attributes:
        rows: ``(n,)`` the closures.
        others: ``(F,)`` those that they may be compared with, in the order of their detection.
        between: ``(n, 4)`` with which of these: from the first to before the second, and from the third on.
    """

    rows: np.ndarray
    others: np.ndarray
    between: np.ndarray


class Repeats(NamedTuple):
    """Of n closures.

    Attributes:
        near, far: ``(S, n)`` for each kernel, densities of turns like those of near and of any false closures.
        has_near, has_far: ``(n,)`` bool, whether there are such.
    """

    near: np.ndarray
    far: np.ndarray
    has_near: np.ndarray
    has_far: np.ndarray


def repeats(closures: Closures, near: Near, gap: float, components: int) -> Repeats:
    """Of some closures.

    Args:
        closures: all.
        near: n of them, and false ones that they are compared with.
        gap: ends are near that are at most so many steps apart.
        components: k.
    """
    return Repeats(*_repeats(closures, near, gap, _Kernels.of(components)))


class _Kernels(NamedTuple):
    """Normal densities.

    Attributes:
        height: ``(S − 1,)`` of each at no difference.
        broadest: rad, standard deviation of the last.
        least_cosine: of half the angle at which that one ends.
    """

    height: np.ndarray
    broadest: float
    least_cosine: float

    @classmethod
    def of(cls, components: int) -> _Kernels:
        width = np.radians(REPEAT_DEG)
        height = (2 * np.pi * width**2) ** (-components / 2)
        return cls(height, float(width[-1]), float(np.cos(_FARTHEST * width[-1] / 2)))


def places_near(when: np.ndarray, asked: np.ndarray, is_one: np.ndarray | None, window: int) -> np.ndarray:
    """``(n, 4)`` which of some closures were detected not long before, and after, others: first and end, of both.

    Args:
        when: ``(F,)`` when they were detected, ascending.
        asked: ``(n,)`` when those others were.
        is_one: ``(n,)`` bool, which of the others are some of them: nobody is near itself; None: those before alone.
        window: so many before, and after, at most.
    """
    earlier = np.searchsorted(when, asked)
    later = np.full_like(earlier, len(when)) if is_one is None else earlier + is_one
    ends = np.maximum(earlier - window, 0), earlier, later, np.minimum(later + window, len(when))
    return np.stack(ends, axis=1)


@compiled
def _repeats(
    closures: Closures, compared: Near, gap: float, kernels: _Kernels
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    older, newer, turn, is_told = closures
    rows, false, between = compared
    height, least_cosine = kernels.height, kernels.least_cosine
    count, broadest = len(rows), -0.5 / kernels.broadest**2
    near, far = np.zeros((len(height) + 1, count)), np.zeros((len(height) + 1, count))
    has_near, has_far = np.zeros(count, np.bool_), np.zeros(count, np.bool_)
    for n in range(count):
        c = rows[n]
        if not is_told[c]:
            continue
        # Whether one was detected shortly before.
        follows = False
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = false[place]
                follows |= is_told[other] and abs(newer[other] - newer[c]) <= gap
        near_total, far_total = 0.0, 0.0
        for side in range(2):
            for place in range(between[n, 2 * side], between[n, 2 * side + 1]):
                other = false[place]
                if not is_told[other]:
                    continue
                by_older, by_newer = abs(older[other] - older[c]), abs(newer[other] - newer[c])
                crossed = min(abs(newer[other] - older[c]), abs(older[other] - newer[c]))
                is_inverse = crossed <= gap and by_older > gap and by_newer > gap
                is_near = by_newer <= gap or (follows and (is_inverse or by_older <= gap))
                weight = (_IN_RUN if by_older + by_newer <= gap else 1.0) if is_near else 0.0
                near_total += weight
                far_total += 1.0
                axis = turn[other, 0] * turn[c, 0] + turn[other, 1] * turn[c, 1] + turn[other, 2] * turn[c, 2]
                real = turn[other, 3] * turn[c, 3]
                cosine = abs(real - axis if is_inverse else real + axis)
                if cosine <= least_cosine:
                    continue
                kernel = np.exp(broadest * (2 * np.arccos(min(cosine, 1.0))) ** 2)
                for s in range(len(height) - 1, -1, -1):
                    near[s, n] += weight * kernel
                    far[s, n] += kernel
                    kernel = (kernel * kernel) ** 2  # half as wide: to the fourth power
        has_near[n], has_far[n] = near_total > 0, far_total > 0
        for s in range(len(height)):
            near[s, n] *= height[s] / max(near_total, 1.0)
            far[s, n] *= height[s] / max(far_total, 1.0)
            near[-1, n] += near[s, n] / len(height)
            far[-1, n] += far[s, n] / len(height)
    return near, far, has_near, has_far
