"""Lengths of odometry steps, and the lengths that the variances of their translations are proportional to."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A step's variance is proportional to its length, and at least that of this share of a typical step: wheels slip even
# on the spot.
_SHORTEST_STEP = 0.05


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
    """Median length in metres of the odometry steps that move at all; 1 if none does.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        is_odometry: ``(M,)`` bool, the edges that count.
    """
    length = way[is_odometry] / steps[is_odometry]
    moving = length[length > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def lengths_passed(way: NDArray[np.float64], steps: NDArray[np.float64], typical: float) -> NDArray[np.float64]:
    """Lengths ``(M,)`` in metres that the edges' variances are proportional to.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        typical: :func:`typical_length` of the graph's odometry.
    """
    return np.asarray(np.maximum(way, _SHORTEST_STEP * typical * steps))
