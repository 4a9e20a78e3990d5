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

# A robot stays upright whose tilt varies by no more than this standard deviation of a component, rad; and turns about
# the vertical so far that no other direction of the world is that steady in its body.
_MOST_TILT, _TURNS = np.radians(15.0), 0.8
# An axis is nearly the vertical within this, rad; and odometry errs about it most if by so many times the variance.
_NEARLY_VERTICAL, _STANDS_OUT = np.radians(20.0), 2.0
# What a step of odometry errs by about other axes than the vertical, over what it errs by about that: standard
# deviation of the logarithm, and the least.
TILT_SPREAD, LEAST_TILT = 1.5, 0.03
# Bodies that tilt by less are told apart by nobody, rad.
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
        """From orientations ``(N, 4)``; None if the body keeps no direction of the world, or more than one.

        Of a direction n of the world the body sees R n. Its mean has the length 1 − τ² where it tilts by N(0, τ²) about
        two axes.
        """
        mean = rotations.to_matrix(body_from_world).mean(dim=0).double()
        _, length, directions = torch.linalg.svd(mean)
        variance = max(1 - float(length[0]), 0.0)
        if variance > _MOST_TILT**2 or float(length[1]) > _TURNS:
            return None
        return cls(directions[0].numpy(), max(variance, _LEAST_TILT**2))

    def sharpened(self, residual: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """``(3,)`` the axis about which odometry errs most, if that is nearly the vertical; else the vertical.

        A robot on slopes does not keep the vertical on average. Where gravity holds the other axes this is nearer.

        Args:
            residual: ``(n, 3)`` rad, of odometry, in the world.
            variance: ``(n,)`` rad².
        """
        square, axes = np.linalg.eigh((residual.T / variance) @ residual)
        stands_out = square[2] > _STANDS_OUT * square[1]
        is_near = abs(axes[:, 2] @ self.axis) > np.cos(_NEARLY_VERTICAL)
        return np.asarray(axes[:, 2] if stands_out and is_near else self.axis)

    def density_ratio(self, turn: np.ndarray, predicted: np.ndarray) -> np.ndarray:
        """``(n,)`` by how much likelier turns are about the vertical, by any angle, than they are among all turns.

        A turn is one about the vertical and a swing of that. Both ends tilt, so the swing is N(0, 2 τ² + p) in two
        components; all turns have the volume 8 π², those about an axis 2 π.

        Args:
            turn: ``(n, 3)`` rad.
            predicted: ``(n,)`` rad², variance p of what these are counted from.
        """
        quaternion = quaternion_rows.exp(np.ascontiguousarray(turn.T))
        about = np.hypot(quaternion[3], self.axis @ quaternion[:3])
        swing = 2 * np.arccos(np.minimum(about, 1.0))
        variance = 2 * self.variance + predicted
        return np.asarray(4 * np.pi * np.exp(-(swing**2) / (2 * variance)) / (2 * np.pi * variance))
