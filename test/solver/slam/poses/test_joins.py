"""Robots that closures alone join: where a few wrong ones that agree are believed first, the others are found."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import NamedTuple

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.metrics.positions import fit_onto, position_errors
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.search.beginnings import runs_to_begin_at
from rotavg_ros.solver.slam.poses.search.joins import joined_otherwise, other_joins
from rotavg_ros.solver.slam.poses.search.settling import Rival
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import EdgeKind

from .test_poses import pose_mode

# Metres between crossings, and the town's width; keyframes of each robot, a metre apart.
BLOCK, SIDE, LENGTH = 15, 60, 280


class Streets(NamedTuple):
    """Robots' graph, the true positions, and which edges are false or join the robots."""

    graph: ViewGraph
    position: np.ndarray
    is_false: np.ndarray
    joins: np.ndarray


def in_a_town(seed: int, robots: int = 2, good: int = 5, false: int = 3, turned_deg: float = 0.0) -> Streets:
    """Robots on the same streets, each with loops of its own; of each two a run of false joins agrees on one motion."""
    rng = np.random.default_rng(seed)
    turns, places = [], []
    for _ in range(robots):
        place, heading, at = [], [], np.array(rng.integers(0, SIDE // BLOCK + 1, 2) * BLOCK)
        while len(place) < LENGTH:
            ways = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
            ahead = [way for way in ways if (at + BLOCK * way >= 0).all() and (at + BLOCK * way <= SIDE).all()]
            way = ahead[rng.integers(len(ahead))]
            place += [at + way * metre for metre in range(BLOCK)]
            heading += [np.arctan2(way[1], way[0])] * BLOCK
            at = at + BLOCK * way
        places.append(np.c_[place, np.zeros(len(place))][:LENGTH])
        turns.append(Rotation.from_rotvec(np.outer(heading[:LENGTH], [0, 0, 1.0])))
    position = np.concatenate(places)
    turn = Rotation.concatenate(turns)
    edges: list[tuple[int, int, Rotation, np.ndarray, int, bool]] = []

    phantom = Rotation.from_rotvec([0, 0, np.radians(turned_deg)])

    def add(
        i: int, j: int, noise_deg: float, noise_m: float, kind: EdgeKind, motion: tuple[int, np.ndarray] | None = None
    ) -> None:
        """An edge from i to j, where j is seen where a motion takes it: a turn about a keyframe, and a shift."""
        error = Rotation.from_rotvec([0, 0, rng.normal(0, np.radians(noise_deg))])
        turned, seen = turn[j], position[j]
        if motion is not None:
            about, moved = motion
            turned, seen = phantom * turn[j], phantom.apply(position[j] - position[about]) + position[about] + moved
        shift = turn[i].inv().apply(seen - position[i]) + np.append(rng.normal(0, noise_m, 2), 0.0)
        edges.append((i, j, turn[i].inv() * turned * error, shift, kind, motion is not None))

    for first in LENGTH * np.arange(robots):
        for i in range(first, first + LENGTH - 1):
            add(i, i + 1, 0.3, 0.03, EdgeKind.ODOMETRY)
        own = position[first : first + LENGTH]
        pairs = np.argwhere(np.linalg.norm(own[:, None] - own, axis=2) < 2)
        pairs = pairs[pairs[:, 1] - pairs[:, 0] > 40] + first
        for i, j in pairs[rng.choice(len(pairs), min(30, len(pairs)), replace=False)]:
            add(i, j, 0.8, 0.08, EdgeKind.LOOP_CLOSURE)
    for one, other in combinations(range(robots), 2):
        apart = np.linalg.norm(places[one][:, None] - places[other], axis=2)
        near = np.argwhere(apart < 2)
        for i, j in near[rng.permutation(len(near))[:good]]:
            add(one * LENGTH + i, other * LENGTH + j, 0.8, 0.08, EdgeKind.LOOP_CLOSURE)
        far = np.argwhere(apart[:-false, :-false] > 20)
        i, j = far[rng.integers(len(far))]
        moved = places[one][i] - places[other][j]
        for step in range(false):
            motion = other * LENGTH + j, moved
            add(one * LENGTH + i + step, other * LENGTH + j + step, 0.8, 0.08, EdgeKind.LOOP_CLOSURE, motion)
    source, target, rotation, translation, kind, is_false = zip(*edges, strict=True)
    graph = ViewGraph.create(
        source,
        target,
        source_from_target=np.array([each.as_quat() for each in rotation]),
        translation=np.array(translation),
        kind=kind,
    )
    return Streets(graph, position, np.array(is_false), np.array(source) // LENGTH != np.array(target) // LENGTH)


def placed_by_false(streets: Streets) -> Rival:
    """The labelling whose false joins are believed, and no others, by rotations as well as by places."""
    pose = pose_mode(streets.graph)
    edge = pose.problem.closures
    false = np.flatnonzero(streets.is_false[edge])
    good = np.flatnonzero(streets.joins[edge] & ~streets.is_false[edge])
    before, rotations = pose.problem.mode, pose.problem.mode.problem
    trusted = before.state.trusted.copy()
    trusted[rotations.closure[false]], trusted[rotations.closure[good]] = 1.0, 0.0
    mode = Mode(rotations, *polish(rotations, replace(before.state, trusted=trusted)), before.origin)
    problem = replace(pose.problem, mode=mode)
    start = replace(PoseStart.joining(pose, false, good).along_odometry(problem), solves=12)
    return Rival(mode, estimate_poses(problem, hold=True, start=start))


@pytest.mark.parametrize("turned_deg", [0.0, 6.0, 30.0])
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 6))])
def test_a_robot_is_placed_by_the_joins_that_make_all_likelier(seed: int, turned_deg: float) -> None:
    """Where false ones turn it, rotations of the good ones are labelled false, and each is off by another shift."""
    streets = in_a_town(seed, turned_deg=turned_deg)
    rival = placed_by_false(streets)
    edge = rival.pose.problem.closures
    false, good = streets.is_false[edge], streets.joins[edge] & ~streets.is_false[edge]
    right = rival.pose.solved.places.right
    assert (right[false] > 0.5).all() and (right[good] < 0.5).all()
    first = other_joins(rival.pose)[0]
    assert set(first.believed) == set(np.flatnonzero(good)) and set(first.doubted) == set(np.flatnonzero(false))
    turn = np.degrees(2 * np.arccos(min(abs(first.turn[3, 0]), 1.0)))
    assert turn == pytest.approx(turned_deg, abs=10.0)  # 280 steps of odometry err by 5°
    placed, *_ = joined_otherwise(rival)
    right = placed.pose.solved.places.right
    assert placed.cost < rival.cost
    assert (right[good] > 0.5).all() and (right[false] < 0.5).all()
    # From there no other group makes it likelier.
    assert joined_otherwise(placed)[0] is placed


@pytest.mark.parametrize(
    ("robots", "good", "false", "seed"), [(4, 2, 3, 2), pytest.param(4, 3, 5, 1, marks=pytest.mark.large)]
)
def test_a_fleet_is_placed_though_each_pair_has_more_false_joins_than_good_ones(
    robots: int, good: int, false: int, seed: int
) -> None:
    """Of each two robots good joins are of more runs, and only what they contradict has to be wrong."""
    streets = in_a_town(seed, robots, good, false)
    solution = solve(streets.graph)
    assert ((solution.outlier_score.numpy() > 0.5) == streets.is_false).all()
    assert solution.position is not None
    assert position_errors(solution.position.numpy(), streets.position).mean() < 0.5


@pytest.mark.parametrize("seed", [3, *(pytest.param(seed, marks=pytest.mark.large) for seed in (0, 1, 2, 4))])
def test_one_join_against_another_is_undecided(seed: int) -> None:
    """Their rotations agree, so that only places differ: nobody can know which one is false."""
    streets = in_a_town(seed, good=1, false=1)
    solution = solve(streets.graph)
    score = solution.outlier_score.numpy()[streets.joins]
    assert ((score > 0.25) & (score < 0.75)).all()
    assert score.sum() == pytest.approx(1.0, abs=0.05)
    assert any("move parts of the map" in warning for warning in solution.warnings)
    # Where the second robot is, beside the first one, is uncertain enough to cover the truth.
    assert solution.position is not None and solution.position_uncertainty is not None
    fit = fit_onto(solution.position.numpy()[:LENGTH], streets.position[:LENGTH])
    assert fit is not None
    off = np.linalg.norm(fit(solution.position.numpy()) - streets.position, axis=1)
    assert (off[LENGTH:] < 3 * np.sqrt(3) * solution.position_uncertainty.numpy()[LENGTH:]).mean() > 0.95


def test_poses_are_not_begun_at_joins() -> None:
    """Odometry predicts them with any variance, so by its measure each would be predicted best."""
    streets = in_a_town(0)
    pose = pose_mode(streets.graph)
    edge = pose.problem.closures
    start = PoseStart.joining(pose, np.flatnonzero(~streets.is_false[edge]), np.flatnonzero(streets.is_false[edge]))
    right = estimate_poses(pose.problem, hold=True, start=replace(start, solves=12))
    assert (right.solved.places.right[streets.is_false[edge]] < 0.5).all()
    assert not any(streets.joins[edge[run]].any() for run in runs_to_begin_at(right))


def test_one_chain_has_no_joins() -> None:
    streets = in_a_town(0)
    first = np.flatnonzero((streets.graph.source.numpy() < LENGTH) & (streets.graph.target.numpy() < LENGTH))
    alone = replace(streets.graph.select_edges(torch.from_numpy(first)), num_nodes=LENGTH)
    assert other_joins(pose_mode(alone)) == []
