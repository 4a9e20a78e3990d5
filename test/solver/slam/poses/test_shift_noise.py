"""How far shifts err: what the search begins with, and what closures near each other have in common."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.poses import false_places
from rotavg_ros.datasets.simulation.poses.drawn import DrawnPoses, Noise, Poses, redrawn
from rotavg_ros.datasets.worlds import World
from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.poses.em.estimate import USUAL, likeliest_level

from .test_poses import HILLS, graph_of, pose_mode, simulated


def with_false_runs(seed: int, noise: Noise, share: float, **options: object) -> DrawnPoses:
    """A run in space; this share of the closures lies in runs that join parallel corridors."""
    run = simulated(seed, **options)
    poses = Poses(Rotation.from_quat(run.world_from_body).inv().as_quat(), run.position, run.planar)
    rng = np.random.default_rng(seed)
    drawn = redrawn(run.graph, poses, noise, rng)
    return false_places.with_share(drawn, share, false_places.parallel_corridors_in_runs, rng)


def city(seed: int, step_m: float) -> DrawnPoses:
    """Half a metre a step."""
    streets = HILLS | {"world": World.CITY, "closures_per_keyframe": 0.25, "keyframe_distance_m": 0.5}
    return with_false_runs(seed, Noise(0.8, step_m, 0.6, 0.01), 0.4, **streets)


def torus(seed: int) -> DrawnPoses:
    """Odometry errs by a hundredth of a step, where a twentieth is usual, and closures by an eighth of one."""
    flights = {"world": World.TORUS, "dimensions": 3, "num_keyframes": 335, "laps": 4.0, "closures_per_keyframe": 0.3}
    lengths = {"keyframe_distance_m": 1.77, "closure_radius_m": 5.0}
    return with_false_runs(seed, Noise(0.37, 0.017, 2.0, 0.23), 0.26, **flights, **lengths)


def right_verdicts(drawn: DrawnPoses) -> float:
    """Share of the closures that are flagged if they are false, and only then."""
    flagged = (solve(drawn.graph).outlier_score > 0.5).numpy()
    return float((flagged == drawn.is_wrong)[drawn.is_closure].mean())


@pytest.mark.large
def test_a_map_does_not_crumple_while_places_are_sorted_out() -> None:
    """Odometry of 10 % a step: were its variance free from the first solves on, it would make room for all runs."""
    drawn = city(0, 0.05)
    answer = solve(drawn.graph)
    assert answer.position is not None
    off = position_errors(answer.position.numpy(), drawn.poses.position)
    assert np.sqrt((off**2).mean()) < 0.3
    assert right_verdicts(drawn) > 0.97


@pytest.mark.parametrize("seed", [1, pytest.param(5, marks=pytest.mark.large)])
def test_false_runs_are_found_from_the_noise_that_odometry_tells(seed: int) -> None:
    """From the usual noise alone a tenth of the closures and more is judged wrongly."""
    assert right_verdicts(torus(seed)) > 0.97


@pytest.mark.large
@torch.no_grad()
def test_the_noise_to_begin_with_is_what_odometry_tells() -> None:
    levels = [likeliest_level(pose_mode(city(0, step_m).graph)) for step_m in (0.0005, 0.05)]
    assert levels[0][0] < USUAL[0] == levels[1][0]


@pytest.mark.large
@torch.no_grad()
def test_what_runs_have_in_common_is_estimated() -> None:
    """Of the variance of closures' translations, from next to none to nearly all."""
    shares = []
    for share in (0.0, 0.8):
        run = simulated(2, num_keyframes=800, closures_per_keyframe=0.6, closure_radius_m=3.0)
        graph = graph_of(run)
        assert graph.translation is not None
        mode = pose_mode(graph)
        problem, rng = mode.problem, np.random.default_rng(0)
        closures, number = problem.closures, problem.run[problem.mode.problem.closure]
        of_run = rng.normal(size=(problem.num_runs + 1, 3))[number]
        noise = np.sqrt(1 - share) * rng.normal(size=of_run.shape) + np.sqrt(share) * of_run
        source = Rotation.from_quat(run.world_from_body[graph.source.numpy()[closures]])
        sign = problem.sign[problem.mode.problem.closure]
        translation = graph.translation.clone()
        translation[closures] += torch.from_numpy(0.3 * sign[:, None] * source.inv().apply(noise * [1, 1, 0]))
        found = pose_mode(replace(graph, translation=translation)).state.noise
        shares.append(found.common / (found.common + found.closure))
    assert shares[0] < 0.25 and shares[1] > 0.6
