"""Positions along corrected orientations, from odometry's steps."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation


@dataclass(frozen=True)
class Trajectory:
    """A robot's keyframes in order of time (K of them).

    Attributes:
        node: ``(K,)`` indices into the answer's keyframes.
        stamp_ns: ``(K,)``.
        world_from_body: ``(K, 4)`` xyzw.
        position: ``(K, 3)`` metres in the world, from the first keyframe's odometry position; NaN without positions.
    """

    node: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    position: NDArray[np.float64]


def dead_reckoning(
    world_from_body: NDArray[np.float64],
    odometry_world_from_body: NDArray[np.float64],
    odometry_position: NDArray[np.float64],
    chain: NDArray[np.int32] | None = None,
) -> NDArray[np.float64]:
    """Odometry's steps, seen from the body, laid along other orientations.

    Args:
        world_from_body: ``(K, 4)`` xyzw, the orientations to use.
        odometry_world_from_body: ``(K, 4)`` xyzw, odometry's own.
        odometry_position: ``(K, 3)`` metres in odometry's frame.
        chain: ``(K,)`` number of the odometry chain; from one to the next the step is unknown and counts as none.

    Returns:
        ``(K, 3)`` metres; the first position is odometry's.
    """
    if len(odometry_position) < 2:
        return odometry_position
    world_from_odometry = Rotation.from_quat(world_from_body) * Rotation.from_quat(odometry_world_from_body).inv()
    steps = world_from_odometry[:-1].apply(np.diff(odometry_position, axis=0))
    if chain is not None:
        steps[np.diff(chain) != 0] = 0.0
    position: NDArray[np.float64] = np.cumsum(np.vstack((odometry_position[:1], steps)), axis=0)
    return position
