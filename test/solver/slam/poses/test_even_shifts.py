"""Closures whose translations err more along one of the body's axes than along others."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.poses.even.shifts import EvenShifts, likeliest_shape
from rotavg_ros.solver.slam.poses.row_errors import even_shifts, stated_covariance
from rotavg_ros.view_graph import ViewGraph

from .test_poses import SimulatedRun, errors, graph_of, pose_mode, simulated
from .test_steps import seen_again

# As a scanner errs in a corridor: ahead, in units of its error sideways.
AHEAD = 8.0
# From the body's axes to those of a camera that looks ahead.
CAMERA = Rotation.from_matrix([[0, 0, 1], [-1, 0, 0], [0, -1, 0]])


def error(graph: ViewGraph, truth: np.ndarray, method: str = "neurora") -> float:
    """Root mean square, metres."""
    position = solve(graph, method=method).position
    assert position is not None
    return float(np.sqrt((position_errors(np.asarray(position), truth) ** 2).mean()))


def of_camera(graph: ViewGraph) -> ViewGraph:
    """The same edges between frames of the body turned as a camera is."""
    assert graph.translation is not None
    turned = CAMERA.inv() * Rotation.from_quat(graph.target_from_source.numpy()) * CAMERA
    way = torch.from_numpy(CAMERA.inv().apply(graph.translation.numpy()))
    return replace(graph, target_from_source=torch.from_numpy(turned.as_quat()), translation=way)


@torch.no_grad()
@pytest.mark.parametrize("camera", [False, True])
def test_the_axes_are_found(camera: bool) -> None:
    """Whatever the body's axes are called."""
    graph, _ = seen_again(0, ahead=AHEAD)
    pose = pose_mode(of_camera(graph) if camera else graph)
    variance, axes = np.linalg.eigh(pose.state.shape)
    assert np.sqrt(variance[-1] / variance[0]) == pytest.approx(AHEAD, rel=0.25)
    ahead = CAMERA.inv().apply([0.0, 1.0, 0.0]) if camera else np.array([0.0, 1.0, 0.0])
    assert abs(axes[:, -1] @ ahead) > 0.99


@torch.no_grad()
def test_the_stated_covariance_is_the_shape_seen_from_the_older_end() -> None:
    """Against SciPy's rotations, of closures at headings all round; what has no shape is alike along all axes."""
    graph, _ = seen_again(0, ahead=AHEAD)
    pose = pose_mode(graph)
    problem, state = pose.problem, pose.state
    covariance = stated_covariance(problem, state.noise, even_shifts(problem, state, np.ones(len(problem.closures))))
    older = np.minimum(graph.source.numpy(), graph.target.numpy())[problem.closures]
    world_from_body = Rotation.from_quat(problem.orientations(state)[older]).inv().as_matrix()
    axes = problem.bases[1]
    shaped = axes.T @ world_from_body @ state.shape @ world_from_body.transpose(0, 2, 1) @ axes
    alike = state.noise.common + state.noise.relative * problem.stated_square
    expected = state.noise.closure * shaped + alike[:, None, None] * np.eye(2)
    np.testing.assert_allclose(covariance, expected, rtol=1e-6, atol=1e-12)


def in_a_building(seed: int, ahead: float) -> tuple[SimulatedRun, ViewGraph]:
    """Places seen from any heading, by closures that err by so many metres more ahead."""
    run = simulated(seed)
    graph = graph_of(run)
    assert graph.translation is not None
    way, closure = graph.translation.clone(), ~graph.is_odometry
    # Closures run from their older to their newer ends, in whose older one's axes a translation is.
    way[closure, 0] += ahead * torch.from_numpy(np.random.default_rng(seed).normal(size=int(closure.sum())))
    return run, replace(graph, translation=way)


@pytest.mark.large
@pytest.mark.parametrize(("ahead", "least", "most"), [(0.4, 0.0, 0.95), (0.0, 0.97, 1.03)])
def test_positions_in_a_building_are_better_by_it(ahead: float, least: float, most: float) -> None:
    """Where closures err more along corridors; otherwise little changes."""
    ratio = []
    for seed in range(3):
        run, graph = in_a_building(seed, ahead)
        found, alike = (errors(run, solve(graph, method=each))[1] for each in ("neurora", "neurora~shift-axes"))
        ratio.append(found / alike)
    assert least < np.exp(np.mean(np.log(ratio))) < most


def test_directions_and_numbers_do_not_matter() -> None:
    """Of closures that see a place from another heading."""
    _, graph = in_a_building(0, 0.4)
    assert graph.translation is not None
    rng = np.random.default_rng(0)
    back = ~graph.is_odometry & torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    turn = Rotation.from_quat(graph.target_from_source.numpy())
    number = torch.from_numpy(rng.permutation(graph.num_nodes))
    source, target = torch.where(back, graph.target, graph.source), torch.where(back, graph.source, graph.target)
    # A translation is that of the target in the source's frame.
    way = torch.from_numpy(-turn.apply(graph.translation.numpy()))
    other = replace(
        graph,
        source=number[source],
        target=number[target],
        target_from_source=torch.where(back[:, None], torch.from_numpy(turn.inv().as_quat()), graph.target_from_source),
        translation=torch.where(back[:, None], way, graph.translation),
    )
    found, renumbered = solve(graph).position, solve(other).position
    assert found is not None and renumbered is not None
    np.testing.assert_allclose(position_errors(renumbered[number].numpy(), found.numpy()), 0.0, atol=1e-4)


@torch.no_grad()
@pytest.mark.parametrize("tilt", [[0.0, 0.0, 0.0], [0.1, 0.05, 0.3], [1.2, -0.4, 0.2]])
def test_axes_of_a_plane_stay(tilt: list[float]) -> None:
    """What is known along them is taken over while a graph grows: rounding must not swap or reverse them."""
    graph, _ = seen_again(0, ahead=AHEAD)
    assert graph.translation is not None
    frame = Rotation.from_rotvec(tilt)
    turned = frame * Rotation.from_quat(graph.target_from_source.numpy()) * frame.inv()
    jitter = Rotation.from_rotvec(1e-15 * np.random.default_rng(0).normal(size=(graph.num_edges, 3)))
    way = torch.from_numpy(frame.apply(graph.translation.numpy()))
    axes = []
    for each in (turned, jitter * turned):
        pose = pose_mode(replace(graph, target_from_source=torch.from_numpy(each.as_quat()), translation=way))
        assert pose.problem.shifts == 2
        axes.append(pose.problem.bases[1])
    np.testing.assert_allclose(axes[0], axes[1], atol=1e-6)


def test_the_shape_of_a_sample_is_found() -> None:
    """Squares of shifts that nothing else predicts badly are those of the shape, and it is where iterations end."""
    rng = np.random.default_rng(0)
    truth = np.array([[4.0, 1.0], [1.0, 0.5]])
    truth /= np.sqrt(np.linalg.det(truth))
    drawn = rng.multivariate_normal(np.zeros(2), truth, 20000)
    shape = np.eye(2)
    for _ in range(3):
        even = EvenShifts.of(shape, np.eye(2)[None], np.ones(1)).even[0]
        pulled = drawn @ even @ even
        shape = likeliest_shape(shape, pulled.T @ pulled, len(drawn) * even @ even)
    np.testing.assert_allclose(shape, truth, rtol=0.05, atol=0.02)
    np.testing.assert_allclose(np.linalg.det(shape), 1.0)
