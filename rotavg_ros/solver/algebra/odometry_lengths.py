"""How far steps of odometry go, and with what their translations' variance goes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

# A step's variance grows with its length, and is that of this share of a typical one at least: wheels slip on the spot.
_SHORTEST_STEP = 0.05


def typical_length(
    translation: NDArray[np.float64], steps: NDArray[np.float64], is_odometry: NDArray[np.bool_]
) -> float:
    """Median length of a step of the odometry that goes anywhere, metres; 1 where none does.

    Args:
        translation: ``(M, 3)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        is_odometry: ``(M,)`` which count.
    """
    length = np.linalg.norm(translation[is_odometry], axis=1) / steps[is_odometry]
    moving = length[length > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def lengths_passed(translation: NDArray[np.float64], steps: NDArray[np.float64], typical: float) -> NDArray[np.float64]:
    """``(M,)`` metres that each edge's variance goes with.

    Args:
        translation: ``(M, 3)`` metres.
        steps: ``(M,)`` odometry steps that each edge stands for.
        typical: :func:`typical_length` of the graph's odometry.
    """
    return np.asarray(np.maximum(np.linalg.norm(translation, axis=1), _SHORTEST_STEP * typical * steps))
