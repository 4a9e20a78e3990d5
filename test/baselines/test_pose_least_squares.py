"""Least squares on poses are GTSAM's, and exact without noise."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.baselines.pose_least_squares import is_planar, pose_least_squares, start_of_poses
from rotavg_ros.metrics import orientation_errors, position_errors
from rotavg_ros.view_graph import ViewGraph


def drive(planar: bool, noise: float, seed: int = 0) -> tuple[ViewGraph, np.ndarray, torch.Tensor, np.ndarray]:
    """A wandering chain with closures: its graph, deviations, true orientations and positions."""
    rng = np.random.default_rng(seed)
    count, axes = 40, np.array([0.0, 0.0, 1.0]) if planar else np.ones(3)
    world_from_body = Rotation.from_rotvec(np.cumsum(0.3 * rng.normal(size=(count, 3)) * axes, axis=0))
    position = np.cumsum(rng.normal(size=(count, 3)) * [1, 1, not planar], axis=0)
    pairs = [(i, i + 1) for i in range(count - 1)] + [(i, (7 * i + 11) % count) for i in range(count)]
    source, target = np.array([pair for pair in pairs if pair[0] != pair[1]]).T
    sigma = rng.uniform(0.5, 2.0, (len(source), 2)) * noise
    turn = Rotation.from_rotvec(rng.normal(size=(len(source), 3)) * axes * sigma[:, :1])
    shift = world_from_body[source].inv().apply(position[target] - position[source])
    shift = shift + rng.normal(size=shift.shape) * [1, 1, not planar] * sigma[:, 1:]
    rotation = turn * world_from_body[target].inv() * world_from_body[source]
    graph = ViewGraph.create(source, target, rotation.as_quat(canonical=True), translation=shift)
    return graph, sigma, torch.from_numpy(world_from_body.inv().as_quat()), position


@pytest.mark.parametrize("planar", [True, False])
def test_without_noise(planar: bool) -> None:
    graph, sigma, orientations, position = drive(planar, 1e-9)
    found = pose_least_squares(graph, sigma, start_of_poses(graph, sigma))
    assert is_planar(graph) == planar
    assert float(orientation_errors(found.body_from_world, orientations).max()) < 1e-6
    assert position_errors(found.position, position).max() < 1e-6


@pytest.mark.parametrize("planar", [True, False])
@pytest.mark.parametrize("noise", [0.01, 0.1])
def test_the_minimum_is_gtsams(planar: bool, noise: float) -> None:
    gtsam = pytest.importorskip("gtsam")
    graph, sigma, _, _ = drive(planar, noise)
    found = pose_least_squares(graph, sigma, start_of_poses(graph, sigma))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    inverse = Rotation.from_quat(graph.target_from_source.numpy()).inv()
    assert graph.translation is not None
    ends = zip(graph.source.tolist(), graph.target.tolist(), strict=True)
    for edge, (source, target) in enumerate(ends):
        step = gtsam.Pose3(gtsam.Rot3(inverse[edge].as_matrix()), graph.translation[edge].numpy())
        model = gtsam.noiseModel.Diagonal.Sigmas(np.repeat(sigma[edge], 3))
        factors.add(gtsam.BetweenFactorPose3(source, target, step, model))
    world_from_body = Rotation.from_quat(found.body_from_world.numpy()).inv()
    for node in range(graph.num_nodes):
        values.insert(node, gtsam.Pose3(gtsam.Rot3(world_from_body[node].as_matrix()), found.position[node]))
    factors.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-4)))
    theirs = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    moved = np.array([theirs.atPose3(node).translation() for node in range(graph.num_nodes)])
    # GTSAM measures a shift's residual in the tangent space of the pose, which differs in the second order of noise.
    assert np.abs(moved - found.position).max() < 2 * noise**2
    assert factors.error(values) <= factors.error(theirs) * (1 + noise)


def test_a_start_far_off_ends_in_the_same_minimum() -> None:
    graph, sigma, _, _ = drive(False, 0.02)
    start = start_of_poses(graph, sigma)
    expected = pose_least_squares(graph, sigma, start)
    rng = np.random.default_rng(5)
    turned = Rotation.from_rotvec(0.2 * rng.normal(size=(graph.num_nodes, 3)))
    body_from_world = turned * Rotation.from_quat(start.body_from_world.numpy())
    away = replace_pose(start, body_from_world, start.position + rng.normal(size=start.position.shape))
    found = pose_least_squares(graph, sigma, away)
    assert position_errors(found.position, expected.position).max() < 1e-4


def replace_pose(start: object, body_from_world: Rotation, position: np.ndarray) -> object:
    return start._replace(body_from_world=torch.from_numpy(body_from_world.as_quat()), position=position)  # type: ignore[attr-defined]


def test_precisions_of_the_graph_do_not_matter() -> None:
    graph, sigma, _, _ = drive(True, 0.02)
    lying = replace(graph, precision=torch.rand(graph.num_edges).double())
    one, other = (pose_least_squares(each, sigma, start_of_poses(each, sigma)) for each in (graph, lying))
    np.testing.assert_allclose(one.position, other.position, atol=1e-9)
