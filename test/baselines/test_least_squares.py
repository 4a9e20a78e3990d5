"""Least squares from a chordal start, against GTSAM and against the truth."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.baselines.least_squares import chordal_orientations, least_squares
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.view_graph import ViewGraph

NUM_NODES = 30


def grid(noise_deg: float, seed: int = 0) -> tuple[ViewGraph, torch.Tensor]:
    """A chain and random closures with noise; every edge states its own precision."""
    generator = torch.Generator().manual_seed(seed)
    truth = rotations.random(NUM_NODES, generator=generator)
    pairs = [(i, i + 1) for i in range(NUM_NODES - 1)] + [(i, (7 * i + 11) % NUM_NODES) for i in range(NUM_NODES)]
    source, target = torch.tensor([pair for pair in pairs if pair[0] != pair[1]]).T
    precision = torch.rand(len(source), generator=generator).double() * 1e4 + 1e3
    vector = noise_deg * torch.randn(len(source), 3, generator=generator).double() / precision.sqrt()[:, None]
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    return ViewGraph.create(
        source, target, rotations.multiply(rotations.exp(vector), relative), precision=precision
    ), truth


def test_noise_free() -> None:
    graph, truth = grid(0.0)
    everything = np.ones(graph.num_edges, dtype=bool)
    for estimate in (chordal_orientations(graph, everything), least_squares(graph, everything)):
        assert float(orientation_errors(estimate, truth).max()) < 1e-7
        torch.testing.assert_close(estimate[0], rotations.identity(), atol=1e-6, rtol=0)


def test_left_out_edges_do_not_count() -> None:
    graph, truth = grid(0.0)
    graph.target_from_source[-3:] = rotations.random(3, generator=torch.Generator().manual_seed(1))
    is_used = np.arange(graph.num_edges) < graph.num_edges - 3
    assert float(orientation_errors(least_squares(graph, is_used), truth).max()) < 1e-5


def test_minimum_is_gtsams() -> None:
    gtsam = pytest.importorskip("gtsam")
    graph, _ = grid(1.0)
    estimate = least_squares(graph, np.ones(graph.num_edges, dtype=bool))
    factors, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    factors.add(gtsam.PriorFactorRot3(0, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    source_from_target = rotations.inverse(graph.target_from_source)
    for edge in range(graph.num_edges):
        x, y, z, w = source_from_target[edge].tolist()
        noise = gtsam.noiseModel.Isotropic.Precision(3, float(graph.precision[edge]))
        ends = int(graph.source[edge]), int(graph.target[edge])
        factors.add(gtsam.BetweenFactorRot3(*ends, gtsam.Rot3.Quaternion(w, x, y, z), noise))
    for node, (x, y, z, w) in enumerate(rotations.inverse(estimate).tolist()):
        values.insert(node, gtsam.Rot3.Quaternion(w, x, y, z))
    solved = gtsam.LevenbergMarquardtOptimizer(factors, values).optimize()
    assert factors.error(values) == pytest.approx(factors.error(solved), rel=1e-4)
    quaternions = [solved.atRot3(node).toQuaternion() for node in range(NUM_NODES)]
    theirs = rotations.inverse(torch.tensor([[q.x(), q.y(), q.z(), q.w()] for q in quaternions]).double())
    assert float(torch.rad2deg(orientation_errors(estimate, theirs)).max()) < 0.05


def test_components_and_unknown_precisions() -> None:
    truth = rotations.random(5, generator=torch.Generator().manual_seed(2))
    source, target = torch.tensor([0, 1, 3]), torch.tensor([1, 2, 4])
    relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    graph = ViewGraph.create(source, target, relative)
    estimate = least_squares(graph, np.ones(3, dtype=bool))
    assert float(orientation_errors(estimate, truth, graph.components()).max()) < 1e-7
