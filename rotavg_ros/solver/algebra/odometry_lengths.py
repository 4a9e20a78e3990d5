"""How far steps of odometry go, and with what their translations' variance goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A step's variance grows with its length, and is that of this share of a typical one at least: wheels slip on the spot.
_SHORTEST_STEP = 0.05


def ways_passed(translation: NDArray[np.float64], along: NDArray[np.float64] | None = None) -> NDArray[np.float64]:
    """``(M,)`` metres from end to end of edges, or along the steps that they were drawn together from, where known.

    Args:
        translation: ``(M, 3)`` metres.
        along: ``(M,)`` metres along the steps, NaN where unknown.
    """
    with np.errstate(over="ignore"):  # a closure may state anything
        straight = np.linalg.norm(translation, axis=1)
    return np.asarray(straight if along is None else np.fmax(straight, along))


def typical_length(way: NDArray[np.float64], steps: NDArray[np.float64], is_odometry: NDArray[np.bool_]) -> float:
    """Median length of a step of the odometry that goes anywhere, metres; 1 where none does.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        is_odometry: ``(M,)`` which count.
    """
    length = way[is_odometry] / steps[is_odometry]
    moving = length[length > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def lengths_passed(way: NDArray[np.float64], steps: NDArray[np.float64], typical: float) -> NDArray[np.float64]:
    """``(M,)`` metres that each edge's variance goes with.

    Args:
        way: ``(M,)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        typical: :func:`typical_length` of the graph's odometry.
    """
    return np.asarray(np.maximum(way, _SHORTEST_STEP * typical * steps))
