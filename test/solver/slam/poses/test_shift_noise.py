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
from rotavg_ros.solver.slam.poses.estimate import USUAL, likeliest_level

from .test_poses import HILLS, graph_of, pose_mode, simulated


def exact_odometry(seed: int, step_m: float) -> DrawnPoses:
    """A city in space, half a metre a step, and two fifths of the closures in runs that join parallel corridors."""
    run = simulated(seed, **HILLS, world=World.CITY, closures_per_keyframe=0.25, keyframe_distance_m=0.5)
    poses = Poses(Rotation.from_quat(run.world_from_body).inv().as_quat(), run.position, run.planar)
    rng = np.random.default_rng(seed)
    drawn = redrawn(run.graph, poses, Noise(0.8, step_m, 0.6, 0.01), rng)
    return false_places.with_share(drawn, 0.4, false_places.parallel_corridors_in_runs, rng)


@pytest.mark.parametrize("step_m", [0.0005, 0.05])
def test_false_runs_are_found_however_well_odometry_tells_lengths(step_m: float) -> None:
    """Were exact odometry taken for a usual one, all runs could join what they claim to."""
    for seed in range(2):
        drawn = exact_odometry(seed, step_m)
        answer = solve(drawn.graph)
        flagged = (answer.outlier_score > 0.5).numpy()
        assert (flagged == drawn.is_wrong)[drawn.is_closure].mean() > 0.97
        assert answer.position is not None
        off = position_errors(answer.position.numpy(), drawn.poses.position)
        assert np.sqrt((off**2).mean()) < 0.3


@torch.no_grad()
def test_the_noise_to_begin_with_is_what_odometry_tells() -> None:
    levels = [likeliest_level(pose_mode(exact_odometry(0, step_m).graph).problem) for step_m in (0.0005, 0.05)]
    assert levels[0] < USUAL == levels[1]


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
