"""Lengths of odometry steps, and the lengths that the variances of their translations are proportional to."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

# A step's variance is proportional to its length, and at least that of this share of a typical step: wheels slip even
# on the spot.
_SHORTEST_STEP = 0.05
# Share of the longest steps that do not tell how far steps usually are: jumps of position are rarer than slips.
_JUMPING = 0.01


def ways_passed(translation: NDArray[np.float64], along: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """Lengths of edges ``(M,)`` in metres: from end to end, or along the merged steps where that is known and longer.

    Args:
        translation: ``(M, 3)`` metres.
        along: ``(M,)`` metres along the steps, NaN where unknown.
    """
    with np.errstate(over="ignore"):  # a closure may state any translation
        straight = np.linalg.norm(translation, axis=1)
    return np.asarray(straight if along is None else np.fmax(straight, along))


def typical_length(way: NDArray[np.float64], steps: NDArray[np.float64], is_odometry: NDArray[np.bool_]) -> float:
    """Median length in metres of the odometry steps that are not on the spot; 1 if none is longer than zero.

    A robot that stands still reports its sensors' noise, a fraction of a millimetre a step, and may stand for most of
    its steps, but it passes next to no way there. So what counts as on the spot is a share of the step at which half of
    the way is passed. Position may jump at a few steps, by more than the whole way; these do not count.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        is_odometry: ``(M,)`` bool, the edges that count.
    """
    length = np.sort(way[is_odometry] / steps[is_odometry])
    usual = length[: len(length) - math.ceil(_JUMPING * len(length))]
    passed = np.cumsum(usual)
    if len(usual) == 0 or not passed[-1] > 0:
        moving = length[length > 0]
        return float(np.median(moving)) if len(moving) else 1.0
    halfway = usual[np.searchsorted(passed, passed[-1] / 2)]
    return float(np.median(length[length > _SHORTEST_STEP * halfway]))


def lengths_passed(way: NDArray[np.float64], steps: NDArray[np.float64], typical: float) -> NDArray[np.float64]:
    """Lengths ``(M,)`` in metres that the edges' variances are proportional to.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        typical: :func:`typical_length` of the graph's odometry.
    """
    return np.asarray(np.maximum(way, _SHORTEST_STEP * typical * steps))
