"""Poses of the key nodes, and variances of odometry and closures, for rotations and translations together."""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np


@dataclass(frozen=True)
class PoseNoise:
    """Variances per component.

    Attributes:
        turn: rad², of one step of odometry, about the vertical where the robot knows one.
        closure_turn: rad², of a good closure whose stated variance is typical.
        way: m² per metre travelled, of odometry.
        closure: m², of a good closure's translation.
        relative: growth of that variance per squared length: some front ends measure directions rather than lengths.
        common: m², additional variance of the error shared by closures near each other.
        step: m² per step of odometry, however long: scans are matched as well from far as from near.
        tilt: rad², of one step of odometry about any other axis, which gravity may hold. Equal to ``turn`` where no
            vertical is known.
        beside: variance of the shifts of odometry beside the chain, relative to the chain's.
    """

    turn: float
    closure_turn: float
    way: float
    closure: float
    relative: float
    common: float
    step: float
    tilt: float
    beside: float = 1.0

    @property
    def logarithms(self) -> np.ndarray:
        """``(9,)``."""
        return np.log(astuple(self))

    @classmethod
    def of(cls, logarithms: np.ndarray) -> PoseNoise:
        """From ``(9,)``."""
        return cls(*np.exp(logarithms).tolist())

    def of_odometry(self, travelled: np.ndarray) -> np.ndarray:
        """``(…,)`` m² per component, variance of odometry that has travelled ``(…, 2)`` metres, and steps."""
        return np.asarray(self.way * travelled[..., 0] + self.step * travelled[..., 1])

    def of_closures(self, square_length: np.ndarray | float) -> np.ndarray:
        """m² per component, total variance of good closures' translations of this squared length, m²."""
        return np.asarray(self.closure + self.common + self.relative * square_length)

    def of_shifts_times(self, of_odometry: float, of_closures: float) -> PoseNoise:
        """The noise with scaled variances of shifts, except the part proportional to length."""
        closure, common = of_closures * self.closure, of_closures * self.common
        way, step = of_odometry * self.way, of_odometry * self.step
        return replace(self, way=way, step=step, closure=closure, common=common)

    def of_constant_times(self, factor: float) -> PoseNoise:
        """The noise with a scaled variance of closures' translations, for what neither grows nor is shared."""
        return replace(self, closure=factor * self.closure)


@dataclass(frozen=True)
class PoseState:
    """State of K key nodes and R runs; d = k + m unknowns each.

    Attributes:
        correction: ``(4, K)`` C, world-frame corrections of the odometry's orientations.
        position: ``(K, 3)`` metres.
        common: ``(R, 6)`` common errors of runs: rad, metres.
        noise: all variances.
        shape: ``(3, 3)`` of what good closures' translations err by however long they are, in the body's axes: its
            covariance up to its size.
    """

    correction: np.ndarray
    position: np.ndarray
    common: np.ndarray
    noise: PoseNoise
    shape: np.ndarray
