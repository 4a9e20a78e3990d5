"""What all measurements of a kind have wrong alike, and a graph without it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.mounting import without_mounting
from rotavg_ros.view_graph import ViewGraph

# In the order in which they are looked for.
PARTS = ("bias", "mounting")


@dataclass(frozen=True)
class Calibration:
    """Of one robot, or of all alike.

    Attributes:
        bias: ``(3,)`` rad per step that odometry turns too much, in the body's frame.
        mounting: ``(3,)`` rad, by which the closures' sensor is mounted otherwise than said, in the body's frame.
    """

    bias: np.ndarray
    mounting: np.ndarray

    @classmethod
    def of(cls, vector: np.ndarray) -> Calibration:
        """From :attr:`vector`."""
        return cls(vector[:3], vector[3:])

    @classmethod
    def none(cls) -> Calibration:
        """All measurements are as they should be."""
        return cls(np.zeros(3), np.zeros(3))

    @property
    def parts(self) -> frozenset[str]:
        """Which of :data:`PARTS` there is something of."""
        return frozenset(part for part in PARTS if getattr(self, part).any())

    @property
    def vector(self) -> np.ndarray:
        """``(6,)`` rad per step and rad: both, one after the other."""
        return np.concatenate((self.bias, self.mounting))

    def moved(self, change: np.ndarray) -> Calibration:
        """With ``(6,)`` more, rad per step and rad, of which is left after this was taken out."""
        both = (rotations.exp(torch.from_numpy(turn)[None]) for turn in (self.mounting, change[3:]))
        return Calibration(self.bias + change[:3], rotations.log(rotations.multiply(*both))[0].numpy())

    def taken_out_of(self, graph: ViewGraph) -> ViewGraph:
        """The graph as it would have been measured without either."""
        if "bias" in self.parts:
            graph = without_bias(graph, self.bias)
        return without_mounting(graph, self.mounting) if "mounting" in self.parts else graph


def calibrated(graph: ViewGraph, calibration: Calibration | None) -> ViewGraph:
    """The graph without what is known to be wrong with all its measurements, if anything is."""
    return graph if calibration is None else calibration.taken_out_of(graph)
