"""What training sees of a robot's own runs: how they err, and what a FineNet explains of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam import stages
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.robot_noise import RobotNoise, held_back, robot_noise
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each, without_repeats
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.view_graph import ViewGraph

__all__ = ["RobotNoise", "RobotRun"]


@dataclass(frozen=True)
class RobotRun:
    """A run that was solved without FineNet.

    Attributes:
        mode: the likeliest labelling.
        truth: ``(4, K)`` true corrections of its key nodes, if known.
    """

    mode: Mode
    truth: np.ndarray | None

    @classmethod
    @torch.no_grad()
    def of(cls, graph: ViewGraph, body_from_world: Tensor | None = None) -> RobotRun:
        """Solve a graph.

        Args:
            graph: N nodes.
            body_from_world: ``(N, 4)`` true orientations, all known.
        """
        repeats = first_of_each(graph)
        graph = graph if repeats is None else without_repeats(graph, *repeats)
        mode = search(graph, Networks("cpu").load(SlamCleanNet), stages.bootstrap).modes[0]
        if body_from_world is None:
            return cls(mode, None)
        return cls(mode, np.ascontiguousarray(mode.problem.graph.corrections(body_from_world).numpy().T))

    def noise(self) -> RobotNoise:
        """How it errs."""
        return robot_noise(self.mode, Networks("cpu").load(SlamFineNet), self.truth)

    def explained(self, networks: Sequence[SlamFineNet | None]) -> np.ndarray:
        """``(B, n)`` nats a closure that each network gives stretches of closures that are held back."""
        return held_back(self.mode, networks)
