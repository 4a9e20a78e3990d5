"""Stated precisions are believed where residuals bear them out, and do no harm where they do not."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, solve
from rotavg_ros.datasets.simulation.slam_simulation import (
    Precisions,
    SimulatedRun,
    SlamSimulationConfig,
    simulate_slam_graph,
)
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.metrics.orientations import orientation_errors

NUM_KEYFRAMES = 300


@cache
def run(seed: int) -> SimulatedRun:
    """Closures that err by 0.3 to 5 degrees, and say so but for a factor."""
    config = SlamSimulationConfig(
        world=World.CITY,
        num_keyframes=NUM_KEYFRAMES,
        odometry_noise_deg=0.5,
        closures_per_keyframe=0.6,
        closure_noise_deg=2.0,
        noise_spread=0.8,
        false_share=0.2,
        precisions=Precisions.SCALED,
        closure_precision_factor=20.0,
    )
    return simulate_slam_graph(config, np.random.default_rng(seed))


def with_precisions(graph: ViewGraph, stated: str, seed: int) -> ViewGraph:
    closure = (~graph.is_odometry).nonzero().squeeze(1)
    precision = graph.precision.clone()
    precision[closure] = {
        "right": precision[closure],
        "missing": torch.full((len(closure),), torch.nan, dtype=torch.float64),
        "next to nothing": torch.full((len(closure),), 5e-324, dtype=torch.float64),
        "unit": torch.ones(len(closure), dtype=torch.float64),
        "permuted": precision[closure[torch.from_numpy(np.random.default_rng(seed).permutation(len(closure)))]],
    }[stated]
    return replace(graph, precision=precision)


def mean_errors(stated: str, num_seeds: int = 2) -> np.ndarray:
    errors = []
    for seed in range(num_seeds):
        solution = solve(with_precisions(run(seed).graph, stated, seed), profile="slam")
        truth = torch.from_numpy(run(seed).world_from_body) * torch.tensor([-1.0, -1.0, -1.0, 1.0])
        errors.append(float(orientation_errors(solution.body_from_world, truth).mean()))
    return np.array(errors)


@pytest.mark.large
def test_right_precisions_help_and_wrong_ones_do_no_harm() -> None:
    missing = mean_errors("missing")
    for uninformative in ("unit", "next to nothing"):
        np.testing.assert_array_equal(mean_errors(uninformative, 1), missing[:1])
    assert np.exp(np.log(mean_errors("right") / missing).mean()) < 0.95
    assert np.abs(np.log(mean_errors("permuted") / missing)).max() < 0.02
