"""Edges that err more about one of the body's axes than about others."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.update.linear import Linear
from rotavg_ros.view_graph import ViewGraph

from .test_poses import HILLS, graph_of, held_by_gravity, pose_mode, simulated

STEP, SHIFT = np.radians(1.0), 0.2
# Deviations about the body's axes, in units of their geometric mean.
UNEVEN = np.array([0.5, 0.5, 4.0])


def sphere(seed: int, uneven: np.ndarray, *, every: int = 1) -> tuple[ViewGraph, Rotation]:
    """Laps around a sphere of 8 m, with one closure to the lap before at every ``every``-th keyframe; and the truth.

    Args:
        uneven: ``(3,)`` deviations about the body's axes, in units of ``STEP``.
    """
    rng = np.random.default_rng(seed)
    laps, per_lap = 8, 20
    number = np.arange(laps * per_lap)
    azimuth, height = 2 * np.pi * number / per_lap, np.linspace(-0.9, 0.9, len(number))
    flat = np.sqrt(1 - height**2)
    place = 8 * np.stack((flat * np.cos(azimuth), flat * np.sin(azimuth), height), axis=1)
    heading = np.gradient(place, axis=0)
    forward = heading / np.linalg.norm(heading, axis=1, keepdims=True)
    up = place / 8 - (place / 8 * forward).sum(axis=1, keepdims=True) * forward
    up /= np.linalg.norm(up, axis=1, keepdims=True)
    world_from_body = Rotation.from_matrix(np.stack((forward, np.cross(up, forward), up), axis=2))
    back = number[per_lap::every]
    source = np.concatenate((number[:-1], back))
    target = np.concatenate((number[1:], back - per_lap))
    turn = rng.normal(size=(len(source), 3)) * STEP * uneven
    relative = Rotation.from_rotvec(turn) * world_from_body[target].inv() * world_from_body[source]
    way = world_from_body[source].inv().apply(place[target] - place[source]) + rng.normal(0, SHIFT, (len(source), 3))
    kind = np.repeat([0, 1], [len(number) - 1, len(back)])
    return ViewGraph.create(source, target, relative.as_quat(), kind=kind, translation=way), world_from_body.inv()


def error(graph: ViewGraph, truth: Rotation, method: str = "neurora") -> float:
    """Mean angle, degrees."""
    answer = solve(graph, method=method).body_from_world
    return float(orientation_errors(answer, torch.from_numpy(truth.as_quat())).rad2deg().mean())


@torch.no_grad()
def test_axes_that_err_more_are_found() -> None:
    graph, _ = sphere(0, UNEVEN)
    pose = pose_mode(graph)
    even = pose.problem.even_turns
    np.testing.assert_allclose(np.linalg.det(even.even), 1.0, rtol=1e-9)
    np.testing.assert_allclose(even.even @ even.uneven, np.tile(np.eye(3), (len(even.even), 1, 1)), atol=1e-9)
    bodies = pose.problem.mode.problem.body_from_world(pose.problem.mode.state.correction)
    drawn = pose.problem.drawn
    for rows in (pose.problem.mode.problem.closure, np.arange(drawn.num_segments)):
        upwards = bodies[drawn.target[rows], 2]
        about, other = np.einsum("ei,eij,ej->e", upwards, even.uneven[rows], upwards), even.even[rows]
        assert np.median(about) > 1.5
        assert np.median(np.linalg.eigvalsh(other)[:, -1]) > 1.2


@pytest.mark.large
@pytest.mark.parametrize("seed", [0, 1])
def test_orientations_are_better_by_it(seed: int) -> None:
    graph, truth = sphere(seed, UNEVEN)
    assert error(graph, truth) < 0.9 * error(graph, truth, "neurora~body-axes")


@pytest.mark.large
def test_where_all_axes_are_alike_little_changes() -> None:
    ratio = []
    for seed in range(2):
        graph, truth = sphere(seed, np.ones(3))
        ratio.append(error(graph, truth) / error(graph, truth, "neurora~body-axes"))
    assert np.exp(np.abs(np.log(ratio)).max()) < 1.03


def test_a_few_closures_tell_little() -> None:
    graph, _ = sphere(0, UNEVEN, every=50)
    pose = pose_mode(graph)
    value = np.linalg.eigvalsh(pose.problem.even_turns.even[pose.problem.mode.problem.closure])
    assert value.max() / value.min() < 1.6


@pytest.mark.large
def test_directions_of_closures_do_not_matter() -> None:
    graph, _ = sphere(0, UNEVEN)
    turned = graph.reverse_edges(~graph.is_odometry & (torch.arange(graph.num_edges) % 2 == 0))
    first, second = solve(graph).body_from_world, solve(turned).body_from_world
    assert float(orientation_errors(second, first).rad2deg().max()) < 1e-6


@torch.no_grad()
def test_the_mean_square_of_a_turn_follows_from_that_of_even_turns() -> None:
    """Published variances are of turns, averaged over components."""
    graph, _ = sphere(0, UNEVEN)
    even = pose_mode(graph).problem.even_turns
    drawn = np.random.default_rng(0).normal(size=(len(even.even), 3, 400))
    np.testing.assert_allclose((even.uneven @ drawn).var(axis=(1, 2)), even.mean_square, rtol=0.3)
    assert (even.mean_square > 1.3).all()


@torch.no_grad()
def test_between_ticks_variances_are_the_mean_over_axes() -> None:
    pose = pose_mode(sphere(0, UNEVEN)[0])
    even, noise, between = pose.problem.even_turns, pose.state.noise, Linear.of_poses(pose).noise
    closure = pose.problem.mode.problem.closure
    assert between.closure_turn == pytest.approx(noise.closure_turn * even.mean_square[closure].mean(), rel=1e-12)
    assert between.turn == pytest.approx(noise.turn * even.mean_square[: closure.min()].mean(), rel=1e-12)


@torch.no_grad()
def test_all_axes_are_alike_in_the_plane_and_if_told_so() -> None:
    plane = pose_mode(graph_of(simulated(1, dimensions=2)))
    assert (plane.problem.even_turns.even == 1).all()
    without = pose_mode(sphere(0, UNEVEN)[0], without={"body-axes"})
    assert (without.problem.even_turns.even == np.eye(3)).all()


@torch.no_grad()
def test_where_gravity_holds_axes_its_ratio_is_what_they_err_by() -> None:
    held = pose_mode(held_by_gravity(simulated(1, **HILLS), 0.6))
    assert (held.problem.even_turns.even == np.eye(3)).all()
