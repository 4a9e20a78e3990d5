"""A solver small enough to trust: orientations along a tree, odometry first."""

from __future__ import annotations

from dataclasses import dataclass, field

import pytest
import torch
from torch import Tensor

from rotavg_ros.online.answer.gauge import extend_along_edges
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


@dataclass(frozen=True)
class TreeSolution:
    body_from_world: Tensor
    outlier_score: Tensor
    component: Tensor
    uncertainty: Tensor
    stage_seconds: dict[str, float] = field(default_factory=dict)
    method: str = "tree"
    profile: str = "slam"
    device: str = "cpu"
    memory: object = None
    warnings: tuple[str, ...] = ()
    position: None = None
    position_uncertainty: None = None
    rotation_score: None = None
    edge_precision: None = None
    step_deviation: float = 0.0
    work: float = 0.0
    is_anew: bool = True


@dataclass
class TreeSolver:
    """Counts its calls, and which of them were warm; ``on_call`` runs in the middle of a solve."""

    calls: int = 0
    warm: int = 0
    on_call: object = None

    def __call__(self, graph: ViewGraph, *, warm_start: Tensor | None, **_: object) -> TreeSolution:
        self.calls += 1
        if warm_start is not None:
            self.warm += 1
            assert warm_start.shape == (graph.num_nodes, 4)
        if callable(self.on_call):
            self.on_call()
        kept = graph.select_edges(graph.label != EdgeLabel.REJECTED)
        return TreeSolution(
            body_from_world=extend_along_edges(torch.empty((0, 4), dtype=torch.float64), kept),
            outlier_score=torch.zeros(graph.num_edges, dtype=torch.float64),
            component=kept.components(),
            uncertainty=torch.zeros(graph.num_nodes, dtype=torch.float64),
        )


@pytest.fixture
def solver() -> TreeSolver:
    return TreeSolver()
