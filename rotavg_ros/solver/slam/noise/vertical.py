"""The vertical of a robot on the ground: the direction of the world that stays constant in its body while it turns.

Places that are mistaken for each other are both upright. So a false closure of such a robot is wrong by a turn of the
world about the vertical, up to variations of the body's tilt, and not by an arbitrary turn.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows

# A robot is upright if the standard deviation of its tilt, per component, is at most the first, rad, and if it turns so
# far about the vertical that the mean of no other direction of the world in its body is longer than the second.
MOST_TILT, _TURNS = np.radians(15.0), 0.8
# An axis is nearly vertical within the first, rad. Odometry errs mostly about one axis if its variance is more than the
# second number times that of the next one.
_NEARLY_VERTICAL, _STANDS_OUT = np.radians(20.0), 2.0
# Ratio of an odometry step's error about the other axes to that about the vertical: standard deviation of its
# logarithm, and its least value.
TILT_SPREAD, LEAST_TILT = 1.5, 0.03
# Lower bound of a body's tilt, rad: smaller ones cannot be distinguished.
_LEAST_TILT = np.radians(2.0)


@dataclass(frozen=True)
class Vertical:
    """The vertical of the world frame in which odometry was contracted.

    Attributes:
        axis: ``(3,)`` unit vector.
        variance: rad² per component, of the body's tilt.
    """

    axis: np.ndarray
    variance: float

    @classmethod
    def of(cls, body_from_world: Tensor) -> Vertical | None:
        """From orientations ``(N, 4)``; None if no direction of the world is constant in the body, or more than one.

        A direction n of the world is R n in the body. If the body tilts by N(0, τ²) about two axes, the mean of R n has
        the length 1 − τ².
        """
        mean = rotations.to_matrix(body_from_world).mean(dim=0).double()
        _, length, directions = torch.linalg.svd(mean)
        variance = max(1 - float(length[0]), 0.0)
        if variance > MOST_TILT**2 or float(length[1]) > _TURNS:
            return None
        return cls(directions[0].numpy(), max(variance, _LEAST_TILT**2))

    def sharpened(self, residual: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """``(3,)`` the axis about which odometry errs most, if that is nearly the vertical; else the vertical.

        A robot on slopes is not upright on average. Where gravity stabilises the other axes, this axis is closer.

        Args:
            residual: ``(n, 3)`` rad, of odometry, in the world's frame.
            variance: ``(n,)`` rad².
        """
        square, axes = np.linalg.eigh((residual.T / variance) @ residual)
        stands_out = square[2] > _STANDS_OUT * square[1]
        is_near = abs(axes[:, 2] @ self.axis) > np.cos(_NEARLY_VERTICAL)
        return np.asarray(axes[:, 2] if stands_out and is_near else self.axis)

    def density_ratio(self, turn: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """``(n,)`` ratio of the density of turns about the vertical, by any angle, to that of all turns.

        A turn consists of a turn about the vertical and a swing of the vertical. Both ends tilt, so the swing is
        N(0, 2 τ² + p) in two components. All turns have the volume 8 π², those about an axis 2 π.

        Args:
            turn: ``(n, 3)`` rad.
            predicted: ``(n,)`` rad², variance p of the prediction that the turns are relative to.
        """
        quaternion = quaternion_rows.exp(np.ascontiguousarray(turn.T))
        about = np.hypot(quaternion[3], self.axis @ quaternion[:3])
        swing = 2 * np.arccos(np.minimum(about, 1.0))
        variance = 2 * self.variance + predicted
        return np.asarray(4 * np.pi * np.exp(-(swing**2) / (2 * variance)) / (2 * np.pi * variance))
