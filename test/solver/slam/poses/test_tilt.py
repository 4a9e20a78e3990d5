"""Odometry whose roll and pitch gravity holds: it errs about the vertical alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.poses.row_errors import bent
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.view_graph import ViewGraph

from .test_poses import HILLS, graph_of, held_by_gravity, pose_mode, simulated


def true_vertical(run: SimulatedRun, pose: PoseMode) -> np.ndarray:
    """``(3,)`` in the world of the odometry, which the first keyframe's orientation ties to the true one."""
    node = int(pose.problem.drawn.nodes[pose.problem.drawn.roots[0]])
    odometry = Rotation.from_quat(pose.problem.mode.problem.graph.odometry_orientation[node].numpy())
    return (odometry.inv() * Rotation.from_quat(run.world_from_body[node]).inv()).apply([0.0, 0.0, 1.0])


def ratio(pose: PoseMode) -> float:
    """Of what a step errs by about other axes to what it errs by about the vertical."""
    return float(np.sqrt(pose.state.noise.tilt / pose.state.noise.turn))


@torch.no_grad()
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 3))])
def test_what_gravity_holds_is_estimated(seed: int) -> None:
    run = simulated(seed, **HILLS)
    held, free = pose_mode(held_by_gravity(run, 0.6, seed)), pose_mode(graph_of(run))
    assert ratio(held) < 0.15
    assert 0.7 < ratio(free) < 1.4
    assert held.problem.drift_axis is not None
    assert abs(held.problem.drift_axis @ true_vertical(run, held)) > np.cos(np.radians(4.0))


@torch.no_grad()
def test_without_a_vertical_all_axes_are_alike() -> None:
    """In the plane there is one axis; and whoever flies loops keeps no direction."""
    plane = pose_mode(simulated_graph(2))
    loops = pose_mode(simulated_graph(3))
    for pose in (plane, loops):
        assert pose.problem.drift_axis is None
        assert pose.state.noise.tilt == pose.state.noise.turn
        assert (pose.problem.about_drift_axis == np.eye(pose.problem.turns)).all()


def simulated_graph(dimensions: int) -> ViewGraph:
    """A run in the plane, or on a sphere."""
    options = {"dimensions": dimensions} | ({"world": "sphere"} if dimensions == 3 else {})
    return graph_of(simulated(1, **options))


@torch.no_grad()
def test_bends_about_the_vertical_are_sums_of_crossed_levers() -> None:
    """Against ∫ (d × n)(d × n)ᵀ of random levers d, as ∫ (‖d‖² I − d dᵀ) is made of the same ones."""
    pose = pose_mode(held_by_gravity(simulated(0, **HILLS), 0.6))
    problem, way = pose.problem, pose.solved.way
    d = np.random.default_rng(0).normal(size=(problem.drawn.num_segments, 40, 3))
    whole = (d**2).sum(axis=(1, 2))[:, None, None] * np.eye(3) - d.transpose(0, 2, 1) @ d
    made = way.bridge.copy()
    made[: len(whole)] = whole
    about, other = bent(problem, replace(way, bridge=made))
    crossed = np.cross(d, problem.drift_axis)
    np.testing.assert_allclose(about, crossed.transpose(0, 2, 1) @ crossed, atol=1e-9)
    np.testing.assert_allclose(about + other, whole, atol=1e-9)


def mean_error(run: SimulatedRun, graph: ViewGraph, method: str) -> float:
    truth = torch.from_numpy(Rotation.from_quat(run.world_from_body).inv().as_quat())
    return float(orientation_errors(solve(graph, method=method).body_from_world, truth).rad2deg().mean())


@pytest.mark.large
@pytest.mark.parametrize(("has_places", "ratio"), [(True, 0.85), (False, 0.92)])
def test_orientations_are_better_by_it(has_places: bool, ratio: float) -> None:
    """And where nothing is held, nothing is lost."""
    held, free = [], []
    for seed in range(4):
        run = simulated(seed, **HILLS, false_share=0.3)
        for made, gained in ((held_by_gravity(run, 0.3, seed), held), (graph_of(run), free)):
            graph = made if has_places else replace(made, translation=None)
            gained.append(np.log(mean_error(run, graph, "neurora") / mean_error(run, graph, "neurora~tilt")))
    assert np.exp(np.mean(held)) < ratio
    assert np.exp(np.mean(free)) < 1.02


def test_other_axes_of_the_body_change_nothing() -> None:
    """Whichever of the body's axes points upwards."""
    run = simulated(1, **HILLS, false_share=0.2)
    graph = held_by_gravity(run, 0.6)
    turned = rotations.normalize(torch.tensor([[0.3, -0.5, 0.2, 0.8]], dtype=torch.float64))
    relative = rotations.multiply(rotations.multiply(turned, graph.target_from_source), rotations.inverse(turned))
    assert graph.translation is not None
    other = ViewGraph.create(
        graph.source,
        graph.target,
        source_from_target=rotations.inverse(relative),
        num_nodes=graph.num_nodes,
        kind=graph.kind,
        precision=graph.precision,
        translation=rotations.rotate(turned, graph.translation),
    )
    first, second = solve(graph).body_from_world, solve(other).body_from_world
    back = rotations.multiply(rotations.inverse(turned), second)
    assert float(orientation_errors(back, first).rad2deg().max()) < 0.05
