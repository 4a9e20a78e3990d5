"""Noise about one axis of the body: squares of one normal component are no tails of three."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.datasets.worlds import World
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.slam.posterior.state import Noise
from rotavg_ros.solver.slam.update.memory import SlamMemory

# The robot turns every way: no axis of the world is any body's.
SPHERE = SlamSimulationConfig(
    world=World.SPHERE,
    dimensions=3,
    num_keyframes=300,
    closures_per_keyframe=0.6,
    odometry_noise_deg=0.0,
    closure_noise_deg=0.0,
    false_share=0.0,
)


def erring(seed: int, about_deg: tuple[float, float, float]) -> tuple[ViewGraph, torch.Tensor]:
    """A graph all of which errs by a normal turn with these standard deviations about the axes of the target's body.

    Returns:
        it, and body_from_world.
    """
    rng = np.random.default_rng(seed)
    run = simulate_slam_graph(SPHERE, rng)
    noise = Rotation.from_rotvec(np.radians(about_deg) * rng.normal(size=(run.graph.num_edges, 3)))
    measured = rotations.multiply(torch.from_numpy(noise.as_quat()), run.graph.target_from_source)
    truth = torch.from_numpy(Rotation.from_quat(run.world_from_body).inv().as_quat())
    return replace(run.graph, target_from_source=rotations.normalize(measured), translation=None), truth


def noise_of(graph: ViewGraph) -> tuple[Noise, torch.Tensor]:
    solution = solve(graph, profile="slam")
    assert isinstance(solution.memory, SlamMemory)
    return solution.memory.noise, solution.body_from_world


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 2))])
def test_what_errs_about_one_axis_of_the_body_has_no_tails_for_that(seed: int) -> None:
    graph, truth = erring(seed, (0.5, 0.5, 2.0))
    noise, answer = noise_of(graph)
    assert noise.step_tails == 0
    # 1 / (q² + 2 ((1 - q)/2)²) / 3 of q = 4 / 4.5
    assert 0.36 < noise.step_told < 0.6
    assert float(orientation_errors(answer, truth).mean()) < np.radians(2.0)
    even, _ = noise_of(erring(seed, (1.2, 1.2, 1.2))[0])
    assert even.step_told > 0.9


def test_the_axes_of_the_body_have_no_names() -> None:
    graph, _ = erring(1, (0.5, 2.0, 0.5))
    turn = torch.from_numpy(Rotation.random(1, random_state=5).as_quat())
    turned = rotations.multiply(rotations.multiply(turn, graph.target_from_source), rotations.inverse(turn))
    one, other = (noise_of(each)[0] for each in (graph, replace(graph, target_from_source=turned)))
    assert one.step_told == pytest.approx(other.step_told, abs=1e-6)


def test_the_end_from_which_edges_are_stated_does_not_matter() -> None:
    graph, _ = erring(2, (0.5, 2.0, 0.5))
    noise, answer = noise_of(graph)
    backwards = torch.from_numpy(np.random.default_rng(0).random(graph.num_edges) < 0.5)
    other, again = noise_of(graph.reverse_edges(backwards))
    assert float(rotations.angle_between(answer, again).max()) < 1e-6
    assert other.step_told == pytest.approx(noise.step_told, abs=1e-6)
