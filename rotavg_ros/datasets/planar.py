"""Rotations about z and steps that stay level, as in planar pose graphs and ground truth."""

from __future__ import annotations

import numpy as np

# Largest x and y of a rotation about z (half angles): allows for the rounding of 32-bit numbers, which is 6e-8.
_ROUNDING = 1e-6
# Largest height of a step that still counts as planar, metres.
_FLAT_M = 1e-6


def are_about_z(quaternions: np.ndarray) -> bool:
    """Whether all of ``(K, 4)`` xyzw rotations are about z."""
    return bool((np.abs(quaternions[:, :2]) <= _ROUNDING).all())


def are_level(steps: np.ndarray | None) -> bool:
    """Whether none of ``(K, 3)`` metres, NaN or None where unknown, goes up or down."""
    return steps is None or bool((np.abs(np.nan_to_num(steps[:, 2])) <= _FLAT_M).all())


def quaternion_of_heading(heading: np.ndarray) -> np.ndarray:
    """``(K,)`` angles in radians to ``(K, 4)`` xyzw, for any finite angle."""
    half = np.asarray(heading) / 2
    zero = np.zeros_like(half)
    return np.stack((zero, zero, np.sin(half), np.cos(half)), axis=-1)


def heading_of_quaternion(quaternions: np.ndarray) -> np.ndarray:
    """``(K, 4)`` rotations about z with w ≥ 0 to ``(K,)`` angles in [-π, π] radians."""
    return np.asarray(2 * np.arctan2(quaternions[:, 2], quaternions[:, 3]))
