"""Systematic errors that all measurements of a kind share, and their removal from a graph."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.mounting import without_mounting
from rotavg_ros.view_graph import ViewGraph

# In the order in which they are estimated.
PARTS = ("bias", "mounting")


@dataclass(frozen=True)
class Calibration:
    """Systematic errors of one robot, or those common to all robots.

    Attributes:
        bias: ``(3,)`` rad per step by which odometry turns too far, in the body's frame.
        mounting: ``(3,)`` rad, deviation of the closures' sensor from its stated mounting, in the body's frame.
        axis: ``(3,)`` unit vector of the body, about which alone the bias may be; None: about any.
    """

    bias: np.ndarray
    mounting: np.ndarray
    axis: np.ndarray | None = None

    @classmethod
    def of(cls, vector: np.ndarray, axis: np.ndarray | None) -> Calibration:
        """From :attr:`vector` and :attr:`axis`."""
        return cls(vector[:3], vector[3:], axis)

    @classmethod
    def none(cls) -> Calibration:
        """No systematic errors."""
        return cls(np.zeros(3), np.zeros(3))

    @property
    def parts(self) -> frozenset[str]:
        """Those of :data:`PARTS` that are not zero."""
        return frozenset(part for part in PARTS if getattr(self, part).any())

    @property
    def vector(self) -> np.ndarray:
        """``(6,)`` rad per step and rad: both, one after the other."""
        return np.concatenate((self.bias, self.mounting))

    def moved(self, change: np.ndarray) -> Calibration:
        """The calibration plus ``(6,)``, rad per step and rad, that remains after it was removed."""
        both = (rotations.exp(torch.from_numpy(turn)[None]) for turn in (self.mounting, change[3:]))
        return replace(self, bias=self.bias + change[:3], mounting=rotations.log(rotations.multiply(*both))[0].numpy())

    def taken_out_of(self, graph: ViewGraph) -> ViewGraph:
        """The graph as it would have been measured without these errors."""
        if "bias" in self.parts:
            graph = without_bias(graph, self.bias)
        return without_mounting(graph, self.mounting) if "mounting" in self.parts else graph


def calibrated(graph: ViewGraph, calibration: Calibration | None) -> ViewGraph:
    """The graph without its known systematic errors, if any."""
    return graph if calibration is None else calibration.taken_out_of(graph)
