"""A constant gyroscope bias."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, solve
from rotavg_ros.metrics.orientations import orientation_errors
from rotavg_ros.solver.slam import preparation as slam_preparation
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from test.solver.graphs import as_quaternions, measured, small_noise

LAP, NUM_NODES = 60, 300
BIAS_DEG = 0.5


def biased_laps() -> tuple[ViewGraph, Rotation]:
    """Planar laps with closures, 30 % of them false, and odometry that turns too far at every step; and the truth."""
    rng = np.random.default_rng(0)
    yaw = 2 * np.pi * np.arange(NUM_NODES) / LAP
    truth = Rotation.from_rotvec(yaw[:, None] * [0, 0, -1])
    later = rng.permutation(np.arange(LAP, NUM_NODES))[:120]
    earlier = later - LAP * rng.integers(1, later // LAP + 1)
    source = np.concatenate((np.arange(NUM_NODES - 1), earlier))
    target = np.concatenate((np.arange(1, NUM_NODES), later))
    vector = small_noise(len(source), np.repeat([0.1, 0.5], [NUM_NODES - 1, len(later)]), 1, planar=True).as_rotvec()
    vector[NUM_NODES - 1 + np.arange(36), 2] = rng.uniform(-3, 3, 36)
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [NUM_NODES - 1, len(later)])
    graph = measured(truth, source, target, Rotation.from_rotvec(vector), kind=kind)
    return without_bias(graph, np.radians([0, 0, -BIAS_DEG])), truth


def test_a_bias_is_found_and_taken_out() -> None:
    graph, truth = biased_laps()
    prepared = slam_preparation.prepare(graph)
    assert np.degrees(np.sqrt(prepared.noise.step_variance)) < 0.2
    assert prepared.noise.outlier_share == pytest.approx(0.3, abs=0.08)
    solution = solve(graph, profile="slam")
    errors = orientation_errors(solution.body_from_world, as_quaternions(truth), graph.components())
    assert np.degrees(float(errors.mean())) < 0.6


def test_it_does_not_matter_which_way_odometry_runs() -> None:
    graph, _ = biased_laps()
    turned = graph.is_odometry & (torch.arange(graph.num_edges) % 3 == 0)
    inverse = graph.target_from_source * torch.tensor([-1.0, -1.0, -1.0, 1.0])
    mixed = ViewGraph.create(
        torch.where(turned, graph.target, graph.source),
        torch.where(turned, graph.source, graph.target),
        torch.where(turned[:, None], inverse, graph.target_from_source),
        kind=graph.kind,
    )
    straight, back = slam_preparation.prepare(graph).noise, slam_preparation.prepare(mixed).noise
    assert back.step_variance == pytest.approx(straight.step_variance, rel=1e-3)
