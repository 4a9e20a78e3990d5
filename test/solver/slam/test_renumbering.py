"""What keyframes are called is nobody's business: by rotations alone the answer is the same to .05 degrees."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve
from rotavg_ros.datasets.simulation.stress.kinds import KINDS
from rotavg_ros.view_graph import ViewGraph


def renumbered(graph: ViewGraph, rng: np.random.Generator) -> tuple[ViewGraph, torch.Tensor]:
    """Other numbers for all keyframes but the first, closures written from their other end; and which is which."""
    number = torch.from_numpy(np.concatenate(([0], 1 + rng.permutation(graph.num_nodes - 1))))
    other = ~graph.is_odometry & torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    source, target = number[graph.source], number[graph.target]
    measured = graph.target_from_source
    changed = replace(
        graph,
        source=torch.where(other, target, source),
        target=torch.where(other, source, target),
        target_from_source=torch.where(other[:, None], rotations.inverse(measured), measured),
    )
    return changed, number


@pytest.mark.parametrize("kind", ["building: 30 % random", "sphere: 50 % random", "grid: 30 % near misses in groups"])
def test_other_numbers_of_keyframes_change_nothing(kind: str) -> None:
    graph = next(each for each in KINDS if each.name == kind).drawn(3).graph
    changed, number = renumbered(graph, np.random.default_rng(0))
    expected, found = solve(graph, profile="slam"), solve(changed, profile="slam")
    cosine = (expected.body_from_world * found.body_from_world[number]).sum(dim=1).abs()
    assert float(torch.rad2deg(2 * torch.acos(cosine.clamp(max=1.0))).max()) < 0.05
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=0.01, rtol=0)
