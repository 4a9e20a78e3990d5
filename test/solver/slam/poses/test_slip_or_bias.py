"""A slip after a whole lap turns all closures alike, as a small bias does; translations tell which it was."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph


@pytest.mark.parametrize("known", [1.0, 0.5])
@pytest.mark.parametrize("seed", [0, 1])
def test_a_slip_between_two_laps_is_no_bias(seed: int, known: float) -> None:
    """By rotations a bias of .06° a step is likelier; then every closure joins wrong places, and all were flagged."""
    config = replace(RobotRun(laps=2).config(), num_keyframes=1200, false_share=0.3)
    run = simulate_slam_graph(config, np.random.default_rng(seed))
    graph, closures = run.graph, ~run.graph.is_odometry
    step = graph.is_odometry & (graph.source == graph.num_nodes // 2)
    slip = rotations.exp(torch.tensor([[0.0, 0.0, -0.6]]).double())
    measured = graph.target_from_source.clone()
    measured[step] = rotations.multiply(slip, measured[step])
    translation = torch.as_tensor(run.edge_translation).clone()
    rows = closures.nonzero()[:, 0]
    translation[rows[np.random.default_rng(0).random(len(rows)) >= known]] = torch.nan
    solution = solve(replace(graph, target_from_source=measured, translation=translation))
    flagged = solution.outlier_score[closures] > 0.5
    np.testing.assert_array_equal(flagged.numpy(), run.closure_is_false[closures.numpy()])
