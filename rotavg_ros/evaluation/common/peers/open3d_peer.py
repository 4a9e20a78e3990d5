"""Open3D's pose-graph optimisation with a line process."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from rotavg_ros.baselines.start import start_orientations
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.peers.running import INLIER_PROBABILITY, from_rows, load, stated_sigma, timed
from rotavg_ros.view_graph import ViewGraph

# Open3D's default: closures of less confidence are dropped, and the rest is solved again.
_PRUNED_CONFIDENCE = 0.25
# The line process's scale μ, in squared standard deviations: a closure whose residual is the inliers' quantile has the
# confidence (μ / (μ + μ))² = ¼, which is where it is dropped.
_SCALE = float(chi2.ppf(INLIER_PROBABILITY, 3))


def line_process(graph: ViewGraph) -> Answer:
    """Open3D's global optimisation (Choi, Zhou & Koltun 2015) by Levenberg–Marquardt, with its default criteria.

    It is told the stated precisions, odometry's orientations as the start, and that only closures are uncertain. All
    translations are zero, so that rotations alone matter. A score is 1 − √l of the line process l, one half where
    Open3D drops a closure. Its residual is the angle's sine, so that an edge off by 180° looks right, and its matrix is
    dense: 6 N rows.
    """
    open3d = load("open3d")
    registration = open3d.pipelines.registration
    is_uncertain = ~graph.is_odometry.numpy()
    pose_graph = _pose_graph(registration, graph, is_uncertain)
    # Copies: the edges themselves are moved.
    edges = [np.array(edge.transformation) for edge in pose_graph.edges]
    clock = Clock()
    with open3d.utility.VerbosityContextManager(open3d.utility.VerbosityLevel.Error), timed(clock):
        registration.global_optimization(
            pose_graph,
            registration.GlobalOptimizationLevenbergMarquardt(),
            registration.GlobalOptimizationConvergenceCriteria(),
            # The scale is the square of the first, times the edges' mean information along z, which is one.
            registration.GlobalOptimizationOption(float(np.sqrt(_SCALE)), _PRUNED_CONFIDENCE, 1.0, -1),
        )
    world_from_body = Rotation.from_matrix([node.pose[:3, :3] for node in pose_graph.nodes])
    answer = from_rows(world_from_body.inv().as_quat(canonical=True).tolist())
    score = torch.from_numpy(1 - np.sqrt(_confidence(graph, edges, pose_graph)))
    return Answer(answer, clock.seconds, clock.cpu_seconds, score)


def _pose_graph(registration: Any, graph: ViewGraph, is_uncertain: np.ndarray) -> Any:
    pose_graph = registration.PoseGraph()
    world_from_body = Rotation.from_quat(start_orientations(graph)[0].numpy()).inv().as_matrix()
    for matrix in world_from_body:
        pose_graph.nodes.append(registration.PoseGraphNode(_pose(matrix)))
    measured = Rotation.from_quat(graph.target_from_source.numpy()).as_matrix()
    precision = stated_sigma(graph).numpy() ** -2
    ends = zip(graph.source.tolist(), graph.target.tolist(), strict=True)
    for edge, (source, target) in enumerate(ends):
        information = np.diag([precision[edge]] * 3 + [1.0] * 3)
        uncertain = bool(is_uncertain[edge])
        pose = _pose(measured[edge])
        pose_graph.edges.append(registration.PoseGraphEdge(source, target, pose, information, uncertain))
    return pose_graph


def _pose(rotation: np.ndarray) -> np.ndarray:
    pose = np.eye(4)
    pose[:3, :3] = rotation
    return pose


def _confidence(graph: ViewGraph, given: list[np.ndarray], solved: Any) -> np.ndarray:
    """``(M,)`` in [0, 1]; 0 for the edges that are gone. Those that are left keep their order."""
    confidence = np.zeros(graph.num_edges)
    left = iter(solved.edges)
    edge = next(left, None)
    for number, ends in enumerate(zip(graph.source.tolist(), graph.target.tolist(), strict=True)):
        if edge is None:
            break
        is_same = (edge.source_node_id, edge.target_node_id) == ends
        if is_same and np.array_equal(edge.transformation, given[number]):
            confidence[number] = edge.confidence
            edge = next(left, None)
    return confidence
