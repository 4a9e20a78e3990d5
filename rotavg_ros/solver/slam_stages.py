"""The stages of a SLAM solve, as the pipeline runs them and as training sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.agreement import AgreementPairs, agreement_pairs
from rotavg_ros.solver.closure_graph import ClosureGraph, contract
from rotavg_ros.solver.noise_model import NoiseModel, discrepancies, estimate_noise
from rotavg_ros.solver.spanning_tree import minimum_spanning_forest
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Odometry first: no number of steps is worth a closure.
_CLOSURE_COST = 1e6
# Rotations whose axes spread less than this (relative) are all about one axis.
_PLANAR_SPREAD = 1e-10


@dataclass(frozen=True)
class Prepared:
    """A SLAM graph drawn together, with the scale of its noise (C closures).

    Attributes:
        closure_graph: the graph of the closures' ends.
        squared_angle: ``(C,)`` rad², discrepancy of each closure with the odometry.
        path_steps: ``(C,)`` odometry steps between its ends; inf where odometry does not connect them.
        pairs: which closures agree.
        noise: estimated scales.
    """

    closure_graph: ClosureGraph
    squared_angle: np.ndarray
    path_steps: np.ndarray
    pairs: AgreementPairs
    noise: NoiseModel

    @property
    def num_segments(self) -> int:
        return self.closure_graph.num_segments


def prepare(graph: ViewGraph) -> Prepared:
    """Contract the odometry chains and estimate the noise of steps and closures. Rejected edges take no part."""
    usable = graph.label != EdgeLabel.REJECTED
    cost = torch.where(graph.is_odometry, 1.0, _CLOSURE_COST)
    # A rejected edge may only be used where nothing else connects.
    forest = minimum_spanning_forest(graph, torch.where(usable, cost, _CLOSURE_COST**2))
    closure_graph = contract(graph, forest)
    closure = closure_graph.is_closure
    squared_angle = (rotations.log(closure_graph.residual) ** 2).sum(dim=1).numpy()[closure]
    path_steps = closure_graph.path_steps[closure]
    pairs = agreement_pairs(closure_graph)
    noise = estimate_noise(discrepancies(squared_angle, path_steps, pairs), rotation_components(graph))
    return Prepared(closure_graph, squared_angle, path_steps, pairs, noise)


def rotation_components(graph: ViewGraph) -> int:
    """1 if all measured rotations share one axis (planar motion), else 3."""
    vectors = rotations.log(graph.target_from_source)
    spread = torch.linalg.eigvalsh(vectors.T @ vectors)
    return 1 if float(spread[1]) <= _PLANAR_SPREAD * float(spread[2]) else 3
