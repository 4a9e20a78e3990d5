"""The precisions that are published: plain least squares with them ends where the answer is."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import solve
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.slam import stress


@pytest.mark.parametrize(("alike", "most"), [(",shift-axes", 0.05), ("", 0.3)])
@pytest.mark.parametrize(
    "kind", ["building: uneven odometry", pytest.param("building: odometry worse in turns", marks=pytest.mark.large)]
)
def test_least_squares_with_published_precisions_is_the_answer(kind: str, alike: str, most: float) -> None:
    """Tails of odometry, its turns, what FineNet makes of each edge, and closures that hardly count."""
    gtsam = pytest.importorskip("gtsam")
    graph = next(drawings(stress.kinds((kind,), translations=True), [2])).graph
    # What closures of a run err alike is no edge's own, and a precision is a mean over axes (a fifth is due to that).
    found = solve(graph, method="neurora~common-errors" + alike)
    assert found.edge_precision is not None and found.position is not None and graph.translation is not None
    precision, position = found.edge_precision.numpy(), found.position.numpy()
    steps = precision[graph.is_odometry.numpy(), 0] * graph.steps.numpy()[graph.is_odometry.numpy()]
    assert steps.max() > 1.3 * steps.min()
    world_from_body = Rotation.from_quat(found.world_from_body.numpy())
    heading = world_from_body.as_rotvec()[:, 2]
    graph = graph.reverse_edges(graph.source > graph.target)  # along the older end's axes, as here
    assert graph.translation is not None
    turn = Rotation.from_quat(graph.target_from_source.numpy()).inv().as_rotvec()[:, 2]
    factors, start = gtsam.NonlinearFactorGraph(), gtsam.Values()
    for node in range(graph.num_nodes):
        start.insert(node, gtsam.Pose2(*position[node, :2], heading[node]))
    for edge, (source, target) in enumerate(torch.stack((graph.source, graph.target), dim=1).tolist()):
        measured = gtsam.Pose2(*graph.translation[edge, :2].tolist(), turn[edge])
        noise = gtsam.noiseModel.Diagonal.Precisions(precision[edge, [1, 1, 0]])
        factors.add(gtsam.BetweenFactorPose2(source, target, measured, noise))
    factors.add(gtsam.PriorFactorPose2(0, start.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    best = gtsam.LevenbergMarquardtOptimizer(factors, start).optimize()
    poses = [best.atPose2(node) for node in range(graph.num_nodes)]
    moved = np.linalg.norm([pose.translation() for pose in poses] - position[:, :2], axis=1)
    turned = np.array([pose.rotation().theta() for pose in poses]) - heading
    turned = np.degrees(np.abs((turned + np.pi) % (2 * np.pi) - np.pi))
    assert found.uncertainty is not None and found.position_uncertainty is not None
    # By next to nothing of what is told to be unknown.
    assert moved.max() < 0.01
    assert (moved[1:] / found.position_uncertainty.numpy()[1:]).max() < most
    assert (turned[1:] / np.degrees(found.uncertainty.numpy()[1:])).max() < most
