"""What a solve returns."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.rotations import angle, canonical, inverse, rotate
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Solution:
    """Absolute orientations and the verdict on every edge (N nodes, M edges).

    Attributes:
        body_from_world: ``(N, 4)`` float64 xyzw, w ≥ 0; the first node of every component is the identity.
        outlier_score: ``(M,)`` float64, probability that the edge's true noise exceeds 20° (SfM) or 10° (SLAM), or,
            where ``position`` is known, that its translation errs by more than 2 m.
        component: ``(N,)`` int64, connected component, numbered by first node.
        uncertainty: ``(N,)`` float64 radians, standard deviation of each component of the orientation error relative
            to the component's first node, so 0 for a node without edges; NaN where the method gives none.
        stage_seconds: wall-clock seconds of each stage that ran.
        method, profile, device: what was run, with "auto" resolved.
        memory: makes the next solve of the same graph, grown a little, cheaper; pass it on unchanged. None if there is
            none.
        position: ``(N, 3)`` float64 metres, each component's first node at the origin, in the frame of its orientation;
            None where translations are unknown or were not used.
        position_uncertainty: ``(N,)`` metres, standard deviation of each component in that frame; None likewise.
        rotation_score: ``(M,)`` probability that the edge's rotation alone errs by more than 10°; None likewise.
        edge_precision: ``(M, 2)`` rad⁻² and m⁻² per component, weights of the edges in the answer, 0 where a
            translation is unknown and for closures that are made of odometry; copies of a measurement share its
            weight; None likewise.
        warnings: reasons not to trust the answer, one sentence each: what was seen, a possible cause, what to do. Nodes
            in them are rows of the graph.
        step_deviation: radians, standard deviation of each component of a step of odometry; NaN where the method does
            not estimate it.
        work: units of work that the solve took, :data:`~rotavg_ros.solver.SECONDS_PER_UNIT` each; counted for robots'
            graphs only, and the same on every machine.
        is_anew: whether the answer is the one that a solve without a memory leads to.
    """

    body_from_world: Tensor
    outlier_score: Tensor
    component: Tensor
    uncertainty: Tensor
    stage_seconds: dict[str, float]
    method: str
    profile: str
    device: str
    memory: object | None = None
    warnings: tuple[str, ...] = ()
    position: Tensor | None = None
    position_uncertainty: Tensor | None = None
    rotation_score: Tensor | None = None
    edge_precision: Tensor | None = None
    step_deviation: float = math.nan
    work: float = 0.0
    is_anew: bool = True

    @property
    def world_from_body(self) -> Tensor:
        """``(N, 4)`` float64 xyzw, w ≥ 0: the orientations as ROS states them."""
        return canonical(inverse(self.body_from_world))


def residual_deg(graph: ViewGraph, solution: Solution) -> np.ndarray:
    """``(M,)`` degrees between each edge's measured rotation and the solution's."""
    ends = graph.source.cpu(), graph.target.cpu()
    return angles_off(solution.body_from_world.cpu(), graph.target_from_source.cpu(), *ends)


def residual_m(graph: ViewGraph, solution: Solution) -> np.ndarray:
    """``(M,)`` metres between each edge's measured translation and the solution's; NaN if either is unknown."""
    if solution.position is None or graph.translation is None:
        return np.full(graph.num_edges, np.nan)
    ends = graph.source.cpu(), graph.target.cpu()
    return distances_off(solution.body_from_world.cpu(), solution.position.cpu(), graph.translation.cpu(), *ends)


def angles_off(body_from_world: Tensor, target_from_source: Tensor, source: Tensor, target: Tensor) -> np.ndarray:
    """``(M,)`` degrees between measured rotations ``(M, 4)`` and those of N orientations."""
    residual = edge_residual(body_from_world, target_from_source, source, target)
    return np.asarray(torch.rad2deg(angle(residual)).numpy())


def distances_off(
    body_from_world: Tensor, position: Tensor, translation: Tensor, source: Tensor, target: Tensor
) -> np.ndarray:
    """``(M,)`` metres between measured translations ``(M, 3)`` and those of N poses; NaN where none is known."""
    measured = rotate(inverse(body_from_world)[source], translation)
    return np.asarray((position[target] - position[source] - measured).norm(dim=1).numpy())
