from __future__ import annotations

from dataclasses import replace

import gtsam
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import (
    Precisions,
    SimulatedRun,
    SlamSimulationConfig,
    SlamSimulationError,
    random_slam_config,
    simulate_slam_graph,
)
from rotavg_ros.datasets.simulation.trajectories import PLANAR_WORLDS, World, chain_rotations
from rotavg_ros.view_graph import EdgeKind


def simulate(seed: int = 0, **changes: object) -> SimulatedRun:
    return simulate_slam_graph(replace(SlamSimulationConfig(), **changes), np.random.default_rng(seed))


def dimensions_of(world: World) -> int:
    return 2 if world in PLANAR_WORLDS else 3


def odometry(run: SimulatedRun) -> np.ndarray:
    return run.graph.kind.numpy() == EdgeKind.ODOMETRY


def closures(run: SimulatedRun) -> np.ndarray:
    return run.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE


@given(seed=st.integers(0, 2**32 - 1), num_keyframes=st.integers(10, 400))
@settings(max_examples=60, deadline=None)
def test_the_whole_family_gives_sound_graphs(seed: int, num_keyframes: int) -> None:
    config = random_slam_config(np.random.default_rng(seed), num_keyframes)
    run = simulate_slam_graph(config, np.random.default_rng(seed))
    graph = run.graph
    assert graph.num_nodes == num_keyframes
    assert int(graph.components().max()) == 0
    assert odometry(run).sum() == num_keyframes - 1
    for values in (run.position, run.world_from_body, run.odometry_position, run.odometry_world_from_body):
        assert np.isfinite(values).all()
    assert np.isfinite(run.edge_translation).all()
    assert bool(torch.isfinite(graph.target_from_source).all())
    assert closures(run).sum() <= round(config.closures_per_keyframe * num_keyframes)
    # Edges come in the order in which a robot would report them.
    assert (np.diff(np.maximum(graph.source.numpy(), graph.target.numpy())) >= 0).all()
    assert not run.closure_is_false[odometry(run)].any()


def test_same_seed_same_run() -> None:
    first, second = simulate(7, false_share=0.4), simulate(7, false_share=0.4)
    other = simulate(8, false_share=0.4)
    assert torch.equal(first.graph.target_from_source, second.graph.target_from_source)
    assert torch.equal(first.graph.source, second.graph.source)
    assert not np.array_equal(first.position, other.position)


@pytest.mark.parametrize("world", World)
def test_odometry_is_the_chain_of_its_edges(world: World) -> None:
    run = simulate(1, world=world, dimensions=dimensions_of(world), odometry_backward=world is World.TORUS)
    edges = np.flatnonzero(odometry(run))
    pose = gtsam.Pose3(gtsam.Rot3(Rotation.from_quat(run.world_from_body[0]).as_matrix()), run.position[0])
    for index in edges:
        rotation = Rotation.from_quat(run.graph.target_from_source[index].numpy()).inv().as_matrix()
        step = gtsam.Pose3(gtsam.Rot3(rotation), run.edge_translation[index])
        source, target = int(run.graph.source[index]), int(run.graph.target[index])
        pose = pose.compose(step if source < target else step.inverse())
    np.testing.assert_allclose(pose.translation(), run.odometry_position[-1], atol=1e-8)
    expected = Rotation.from_quat(run.odometry_world_from_body[-1]).as_matrix()
    np.testing.assert_allclose(pose.rotation().matrix(), expected, atol=1e-9)


@pytest.mark.parametrize("world", World)
def test_perfect_measurements_close_every_loop(world: World) -> None:
    run = simulate(
        2,
        world=world,
        dimensions=dimensions_of(world),
        odometry_noise_deg=0,
        odometry_translation_noise=0,
        closure_noise_deg=0,
        closure_translation_noise_m=0,
        false_share=0,
    )
    np.testing.assert_allclose(run.odometry_position, run.position, atol=1e-7)
    assert run.edge_noise.max() < 1e-7
    assert closures(run).sum() > 100, "the robot comes back to where it has been"
    source, target = run.graph.source.numpy(), run.graph.target.numpy()
    world_from_source = Rotation.from_quat(run.world_from_body[source])
    reached = run.position[source] + world_from_source.apply(run.edge_translation)
    np.testing.assert_allclose(reached, run.position[target], atol=1e-7)


@pytest.mark.parametrize("world", World)
def test_closures_are_near_in_space_and_apart_in_time(world: World) -> None:
    run = simulate(3, world=world, dimensions=dimensions_of(world), false_share=0, closure_radius_m=1.2)
    chosen = closures(run)
    source, target = run.graph.source.numpy()[chosen], run.graph.target.numpy()[chosen]
    assert np.linalg.norm(run.position[source] - run.position[target], axis=1).max() <= 1.2
    assert np.abs(source - target).min() >= SlamSimulationConfig().min_closure_gap
    # Both directions, and no pair twice.
    assert 0.3 < (source > target).mean() < 0.7
    pairs = np.stack((np.minimum(source, target), np.maximum(source, target)))
    assert len(np.unique(pairs, axis=1).T) == len(source)


def test_short_range_closures() -> None:
    run = simulate(4, short_range_share=0.5, false_share=0, closures_per_keyframe=0.4)
    chosen = closures(run)
    gap = (run.graph.source - run.graph.target).abs().numpy()[chosen]
    assert 0.4 < (gap <= 8).mean() <= 0.5
    assert gap.min() >= 2


@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("spread", [0.0, 0.5])
def test_noise_is_as_asked_for(dimensions: int, spread: float) -> None:
    run = simulate(
        5,
        world=World.CITY,
        dimensions=dimensions,
        num_keyframes=8000,
        odometry_noise_deg=0.3,
        closure_noise_deg=2.0,
        noise_spread=spread,
        closures_per_keyframe=0.5,
        false_share=0,
    )
    for chosen, expected in ((odometry(run), 0.3), (closures(run), 2.0)):
        angle = np.degrees(run.edge_noise[chosen])
        assert np.sqrt((angle**2).mean()) == pytest.approx(expected, rel=0.1)
    # Stated precisions are those of the noise: residuals in units of their standard deviation are standard normal.
    axes = 1 if dimensions == 2 else 3
    normalised = run.edge_noise**2 * run.graph.precision.numpy() / axes
    assert normalised.mean() == pytest.approx(1, rel=0.1)


@pytest.mark.parametrize("grouped", [0.0, 1.0])
@pytest.mark.parametrize("dimensions", [2, 3])
@pytest.mark.parametrize("share", [0.0, 0.3, 0.8])
def test_share_of_false_closures(share: float, dimensions: int, grouped: float) -> None:
    run = simulate(
        6, dimensions=dimensions, num_keyframes=3000, false_share=share, grouped_share=grouped, closure_noise_deg=0.5
    )
    assert run.closure_is_false.sum() / closures(run).sum() == pytest.approx(share, abs=0.01)


def test_near_misses() -> None:
    run = simulate(7, num_keyframes=3000, false_share=0.5, near_miss_share=1.0, closure_noise_deg=0.01)
    angle = np.degrees(run.edge_noise[run.closure_is_false])
    assert angle.min() > 10
    assert angle.max() < 30.1
    assert run.closure_is_false.sum() == round(0.5 * closures(run).sum())


def test_groups_share_one_wrong_world_rotation() -> None:
    run = simulate(8, dimensions=3, num_keyframes=3000, false_share=0.4, grouped_share=1.0, closure_noise_deg=0.01)
    chosen = np.flatnonzero(run.closure_is_false)
    source, target = run.graph.source.numpy()[chosen], run.graph.target.numpy()[chosen]
    older, newer = np.minimum(source, target), np.maximum(source, target)
    measured = Rotation.from_quat(run.graph.target_from_source[chosen].numpy()).as_quat()
    measured[source > target, :3] *= -1  # newer_from_older, whichever way the edge runs
    wrong = (
        Rotation.from_quat(run.world_from_body[newer])
        * Rotation.from_quat(measured)
        * Rotation.from_quat(run.world_from_body[older]).inv()
    ).as_rotvec()
    distance = np.linalg.norm(wrong[:, None] - wrong[None], axis=2)
    companions = (distance < np.radians(1)).sum(axis=1)  # itself among them
    assert companions.min() >= 4
    assert companions.max() <= 12


@pytest.mark.parametrize("world", PLANAR_WORLDS)
def test_planar_means_yaw_only(world: World) -> None:
    run = simulate(9, world=world, false_share=0.5, grouped_share=0.3, near_miss_share=0.3, slip_share=0.05, sway_deg=3)
    assert run.planar
    for quaternions in (run.graph.target_from_source.numpy(), run.world_from_body, run.odometry_world_from_body):
        assert np.abs(quaternions[:, :2]).max() < 1e-12
    assert np.abs(run.position[:, 2]).max() == 0
    assert np.abs(run.edge_translation[:, 2]).max() < 1e-12


def test_terrain_tilts_the_body_as_asked_for() -> None:
    run = simulate(10, world=World.CITY, dimensions=3, num_keyframes=4000, terrain_tilt_deg=8.0)
    up = Rotation.from_quat(run.world_from_body).apply([0, 0, 1])
    tilt = np.degrees(np.arccos(up[:, 2]))
    assert 4 < np.sqrt((tilt**2).mean()) < 12
    # The body's x axis points along the path, uphill and downhill too.
    forward = Rotation.from_quat(run.world_from_body[:-1]).apply([1, 0, 0])
    step = np.diff(run.position, axis=0)
    step /= np.linalg.norm(step, axis=1, keepdims=True)
    assert np.median((forward * step).sum(axis=1)) > 0.99


def test_slips() -> None:
    run = simulate(11, num_keyframes=2000, slip_share=0.02, odometry_noise_deg=0.1)
    angle = np.degrees(run.edge_noise[odometry(run)])
    slipped = angle > 10
    assert slipped.sum() == round(0.02 * 1999)
    assert angle[slipped].min() > 19
    assert angle[slipped].max() < 61


@pytest.mark.parametrize(
    ("precisions", "expected"),
    [(Precisions.MISSING, np.nan), (Precisions.UNIT, 1.0), (Precisions.SCALED, 100 / np.radians(1.0) ** 2)],
)
def test_stated_precisions(precisions: Precisions, expected: float) -> None:
    run = simulate(12, precisions=precisions, closure_noise_deg=1.0, closure_precision_factor=100.0)
    np.testing.assert_allclose(run.graph.precision.numpy()[closures(run)], expected)


def test_the_family_is_wide() -> None:
    rng = np.random.default_rng(0)
    configs = [random_slam_config(rng) for _ in range(500)]
    assert {config.world for config in configs} == set(World)
    assert {config.dimensions for config in configs} == {2, 3}
    assert {config.precisions for config in configs} == set(Precisions)
    keyframes = [config.num_keyframes for config in configs]
    assert min(keyframes) < 150
    assert max(keyframes) > 8000
    noise = [config.odometry_noise_deg for config in configs]
    assert min(noise) < 0.02
    assert max(noise) > 4
    density = [config.closures_per_keyframe for config in configs]
    assert min(density) < 0.006
    assert max(density) > 1
    assert 0.75 < max(config.false_share for config in configs) <= 0.8
    assert any(config.false_share == 0 for config in configs)
    assert any(config.slip_share > 0 for config in configs)


def test_as_a_graph_file() -> None:
    run = simulate(13)
    graph_file = run.to_graph_file()
    truth = Rotation.from_quat(graph_file.body_from_world_gt) * Rotation.from_quat(run.world_from_body)
    assert truth.magnitude().max() < 1e-12
    assert (np.diff(graph_file.stamps_ns) == 500_000_000).all()


@pytest.mark.parametrize(
    "changes",
    [
        {"dimensions": 4},
        {"world": World.SPHERE},
        {"terrain_tilt_deg": 3.0},
        {"num_keyframes": 5},
        {"false_share": 1.2},
        {"grouped_share": 0.7, "near_miss_share": 0.7},
        {"laps": 0},
        {"closure_noise_deg": -1.0},
    ],
)
def test_impossible_configs_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(SlamSimulationError):
        replace(SlamSimulationConfig(), **changes)


@given(st.integers(1, 70))
@settings(deadline=None)
def test_chained_rotations_are_running_products(count: int) -> None:
    steps = Rotation.random(count, rng=np.random.default_rng(count))
    expected = steps[0]
    chained = Rotation.from_quat(chain_rotations(steps.as_quat()))
    for index in range(count):
        expected = steps[index] if index == 0 else expected * steps[index]
        assert (chained[index].inv() * expected).magnitude() < 1e-12
