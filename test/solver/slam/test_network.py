"""What solves compute of closures in tiles and in closed form, against the specification and scipy."""

from __future__ import annotations

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.scarce_evidence import several_robots
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.solver.algebra.spanning_forest import minimum_spanning_forest
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.slam.graph.agreement import agreement_pairs
from rotavg_ros.solver.slam.graph.closure_graph import contract
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths
from rotavg_ros.solver.slam.network import closure_features, false_log_odds
from rotavg_ros.solver.slam.preparation import prepare
from test.solver.graphs import measured, random_truth, slam_edges, small_noise


def test_the_network_in_tiles_is_its_forward() -> None:
    source, target, kind = slam_edges(300, 700, seed=3)
    noise = small_noise(len(source), 1.0, seed=4)
    prepared = prepare(measured(random_truth(300, seed=2), source, target, noise, kind=kind))
    features = closure_features(prepared.noise, prepared.squared_angle, prepared.path_steps, prepared.pairs)
    network = load_network(NETWORKS["slam-clean-net"], "cpu")
    with torch.no_grad():
        torch.testing.assert_close(false_log_odds(network, features), network(features), rtol=1e-5, atol=1e-4)


def test_neighbours_disagree_by_scipys_angle() -> None:
    source, target, kind = slam_edges(60, 40, seed=5)
    graph = measured(random_truth(60, seed=6), source, target, small_noise(len(source), 20.0, seed=7), kind=kind)
    forest = minimum_spanning_forest(graph, torch.where(graph.is_odometry, 1.0, 1e6))
    contracted = contract(graph, OdometryPaths.along(graph, forest))
    pairs = agreement_pairs(contracted)
    closure = np.flatnonzero(contracted.is_closure)
    residual = Rotation.from_quat(contracted.residual[closure].numpy())
    start, end = (contracted.position[ends[closure]] for ends in (contracted.source, contracted.target))
    forward = Rotation.concatenate(
        [one if a < b else one.inv() for one, a, b in zip(residual, start, end, strict=True)]
    )
    angle = (forward[pairs.first].inv() * forward[pairs.second]).magnitude()
    np.testing.assert_allclose(np.sqrt(pairs.squared_angle), angle, rtol=1e-9, atol=3e-8)


def test_between_robots_nothing_depends_on_the_closure_that_draws_them_together() -> None:
    """The residuals of all others between two chains are told from that one, whether it is good or false."""
    run = simulate_slam_graph(
        SlamSimulationConfig(num_keyframes=120, closures_per_keyframe=0.3), np.random.default_rng(0)
    )
    prepared = prepare(several_robots(run, np.random.default_rng(0)).graph)
    is_between = ~np.isfinite(prepared.path_steps)
    assert is_between.sum() > 2
    other = np.where(is_between, 1.0 + prepared.squared_angle, prepared.squared_angle)
    for squared_angle in (prepared.squared_angle, other):
        features = closure_features(prepared.noise, squared_angle, prepared.path_steps, prepared.pairs).closures
        assert features[torch.from_numpy(is_between)].unique(dim=0).shape[0] == 1
