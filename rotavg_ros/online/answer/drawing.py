"""An answer as points, lines and colours, for whoever turns them into messages."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.answer.trajectory import Trajectory

EDGE_WIDTH_M = 0.03
KEYFRAME_SIZE_M = 0.12
# Red, green, blue, opacity.
KEYFRAME_COLOR = (0.15, 0.35, 0.75, 1.0)
# Edges from inlier (green) to outlier (red).
PALETTE = tuple((share, 0.75 * (1 - share), 0.1, 0.5 + 0.5 * share) for share in np.linspace(0, 1, 32).tolist())


@dataclass(frozen=True)
class Drawing:
    """Keyframes whose positions are known (K), and the edges between them (E).

    Attributes:
        keyframes: ``(K, 3)`` metres.
        edge_ends: ``(2 E, 3)`` metres, source and target of each edge in turn.
        edge_shades: ``(E,)`` indices into :data:`PALETTE`.
    """

    keyframes: NDArray[np.float64]
    edge_ends: NDArray[np.float64]
    edge_shades: NDArray[np.int64]


def draw(answer: Answer, trajectories: Iterable[Trajectory]) -> Drawing:
    """Draw an answer. Keyframes without a known position are left out, and their edges with them."""
    position = np.full((len(answer.keyframe_id), 3), np.nan)
    for trajectory in trajectories:
        position[trajectory.node] = trajectory.position
    placed = np.isfinite(position).all(axis=1)
    shown = np.flatnonzero(placed[answer.source] & placed[answer.target])
    ends = np.stack((answer.source[shown], answer.target[shown]), axis=1).ravel()
    shades = np.rint(np.nan_to_num(answer.outlier_score[shown]) * (len(PALETTE) - 1)).astype(np.int64)
    return Drawing(position[placed], position[ends], shades)
