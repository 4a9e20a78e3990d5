"""Two robots that closures alone join, most of them false at random: these say nothing of where a robot lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.search.settling import Rival
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import EdgeKind

from .test_joins import LENGTH, Streets, in_a_town
from .test_poses import pose_mode


def among_random_joins(seed: int, good: int, count: int) -> Streets:
    """Robots of a town with as many good joins, and a number of others between any keyframes, by any turn."""
    town = in_a_town(seed, good=good)
    kept = np.flatnonzero(~town.is_false)
    before, rng = town.graph.select_edges(torch.from_numpy(kept)), np.random.default_rng(seed)
    assert before.translation is not None
    source, target = rng.integers(0, LENGTH, count), rng.integers(LENGTH, 2 * LENGTH, count)
    turn = Rotation.from_rotvec(np.outer(rng.uniform(-np.pi, np.pi, count), [0, 0, 1.0]))
    shift = np.c_[rng.normal(0, 1, (count, 2)), np.zeros(count)]
    graph = ViewGraph.create(
        np.r_[before.source, source],
        np.r_[before.target, target],
        target_from_source=np.r_[before.target_from_source.numpy(), turn.inv().as_quat()],
        translation=np.r_[before.translation.numpy(), shift],
        kind=np.r_[before.kind.numpy(), np.full(count, EdgeKind.LOOP_CLOSURE)],
        num_nodes=2 * LENGTH,
    )
    is_false = np.r_[town.is_false[kept], np.ones(count, dtype=bool)]
    return Streets(graph, town.position, is_false, np.r_[town.joins[kept], np.ones(count, dtype=bool)])


@pytest.mark.parametrize(
    "seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in (1, 2, 3, 4, 5, 6, 8, 9))]
)
def test_eight_joins_that_agree_are_found_among_a_hundred_random_ones(seed: int) -> None:
    streets = among_random_joins(seed, good=8, count=100)
    solution = solve(streets.graph)
    is_flagged = solution.outlier_score.numpy() > 0.5
    assert (is_flagged == streets.is_false)[streets.joins].mean() > 0.98
    assert solution.position is not None
    assert position_errors(solution.position.numpy(), streets.position).mean() < 1.0


def test_random_joins_are_as_likely_wherever_a_robot_lies() -> None:
    """By any single one of them a robot lies elsewhere on the other's map, and all others are false as before."""
    streets = among_random_joins(0, good=0, count=60)
    pose = pose_mode(streets.graph)
    joins = np.flatnonzero(streets.joins[pose.problem.closures])
    rotations, before = pose.problem.mode.problem, pose.problem.mode.state
    costs = []
    for believed in joins[::6]:
        trusted = before.trusted.copy()
        trusted[rotations.closure[joins]] = joins == believed
        mode = Mode(rotations, *polish(rotations, replace(before, trusted=trusted)), pose.problem.mode.origin)
        problem = replace(pose.problem, mode=mode, extent=pose.solved.scale.extent)
        start = PoseStart.joining(pose, np.array([believed]), np.setdiff1d(joins, believed)).along_odometry(problem)
        costs.append(Rival(mode, estimate_poses(problem, hold=True, start=start)).cost)
    # What is left is what they repeat of each other by chance. By normal densities about the map it was 18.
    assert np.std(costs) < 10.0


@pytest.mark.parametrize("seed", [8, 10])
def test_two_robots_of_exact_odometry_that_random_closures_join_have_an_answer(seed: int) -> None:
    """Steps and links over two steps that agree exactly are as stiff as priors allow, and hardly anything joins them.

    One such drawing in seven had ended in an exception.
    """
    rng = np.random.default_rng(seed)
    edges: list[tuple[int, int, EdgeKind, Rotation, np.ndarray]] = []
    for first, count in ((0, 6), (6, 18)):
        turns, places = [Rotation.from_rotvec([0, 0, rng.normal()])], [rng.normal(size=3)]
        for _ in range(count - 1):
            places.append(places[-1] + turns[-1].apply([0.4, 0, 0]))
            turns.append(turns[-1] * Rotation.from_rotvec(0.15 * rng.normal(size=3)))
        steps = [(i, i + 1) for i in range(count - 1)]
        for i, j in steps + [(i, i + 2) for i in range(count - 2) if rng.random() < 0.5]:
            back = turns[i].inv()
            edges.append((first + i, first + j, EdgeKind.ODOMETRY, back * turns[j], back.apply(places[j] - places[i])))
    for _ in range(5):
        ends = int(rng.integers(0, 6)), 6 + int(rng.integers(0, 18))
        wrong = Rotation.random(random_state=int(rng.integers(1 << 30)))
        edges.append((*ends, EdgeKind.LOOP_CLOSURE, wrong, 4 * rng.normal(size=3)))
    source, target, kind, turned, moved = zip(*edges, strict=True)
    stated = np.array([each.as_quat() for each in turned])
    graph = ViewGraph.create(source, target, source_from_target=stated, kind=kind, translation=np.array(moved))
    solution = solve(graph)
    assert solution.position is not None and solution.position.isfinite().all()
    assert solution.uncertainty.isfinite().all()
