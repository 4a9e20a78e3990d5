"""Whole runs of closures that are believed after all, or doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.stats import chi2, false_discovery_control

from rotavg_ros.solver.slam.poses.closures import NOTHING
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.rows import jacobian, root_weight, whitening
from rotavg_ros.solver.slam.poses.search.runs import (
    runs_to_believe,
    runs_to_doubt,
    too_large,
    unlikely_offsets,
    without_runs,
)
from rotavg_ros.solver.slam.poses.search.settling import Rival
from rotavg_ros.solver.slam.poses.solved import PoseMode

from .test_floors import building
from .test_poses import graph_of, pose_mode, simulated


def held_wrong(pose: PoseMode) -> tuple[PoseMode, np.ndarray]:
    """The same where the longest run is held to join wrong places, all of it; and its closures."""
    right = pose.solved.places.right > 0.5
    run = int(np.argmax(np.bincount(pose.problem.told.run, right)))
    members = np.flatnonzero(right & (pose.problem.told.run == run))
    start = replace(PoseStart.doubting(pose, members), solves=1)
    turn = start.places.rotation_weight.copy()
    turn[members] *= NOTHING
    start = replace(start, places=replace(start.places, rotation_weight=turn))
    return estimate_poses(pose.problem, start=start), members


@pytest.mark.parametrize("count", [0, 1, 3, 40, 400])
def test_errors_are_improbable_among_as_many_as_there_are(count: int) -> None:
    """As SciPy controls false discoveries; some of right runs, some of three times their deviation."""
    rng = np.random.default_rng(count)
    square = rng.chisquare(3, count) * np.where(np.arange(count) % 7 == 2, 9.0, 1.0)
    expected = np.flatnonzero(false_discovery_control(chi2.sf(square, 3)) <= 0.05) if count else np.zeros(0)
    found = too_large(square, 3)
    np.testing.assert_array_equal(np.sort(found), expected)
    assert (np.diff(square[found]) <= 0).all()


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.large) for seed in (2, 5))])
def test_a_run_that_is_right_is_likelier_to_be(seed: int) -> None:
    pose = pose_mode(graph_of(simulated(seed)))
    without, members = held_wrong(pose)
    gained = {tuple(found): nats for nats, found in runs_to_believe(without)}
    best = max(gained, key=lambda found: len(set(found) & set(members.tolist())))
    assert set(best) & set(members.tolist())
    assert gained[best] > 0
    believed = estimate_poses(pose.problem, start=PoseStart.believing(without, np.array(best)))
    assert (believed.solved.places.right[list(best)] > 0.5).all()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 3))])
def test_a_run_of_wrong_places_is_not(seed: int) -> None:
    run = simulated(seed, false_share=0.3, grouped_share=1.0)
    pose = pose_mode(graph_of(run))
    is_false = run.closure_is_false[pose.problem.closures]
    assert (np.bincount(pose.problem.told.run, is_false) >= 3).any()
    assert not any(is_false[found].any() for nats, found in runs_to_believe(pose) if nats > -1)


def bent(seed: int) -> tuple[Rival, np.ndarray]:
    """A labelling whose map is bent by the longest run of closures of another floor, all believed; and these."""
    made = building(seed, floors=2, false_share=0.25)
    pose = pose_mode(made.graph)
    problem = pose.problem
    is_false = made.is_false[problem.closures - (len(made.position) - 1)]
    longest = int(np.argmax(np.bincount(problem.told.run, is_false)))
    members = np.flatnonzero(is_false & (problem.told.run == longest))
    start = replace(PoseStart.believing(pose, members), solves=3)
    return Rival(problem.mode, estimate_poses(problem, hold=True, start=start)), members


@pytest.mark.parametrize("seed", [1, *(pytest.param(seed, marks=pytest.mark.large) for seed in (2, 6))])
def test_a_run_that_bends_the_map_is_doubted(seed: int) -> None:
    rival, members = bent(seed)
    assert (rival.pose.solved.places.right[members] > 0.5).all()
    doubted = [set(found.tolist()) for found in runs_to_doubt(rival.pose)]
    assert any(set(members.tolist()) <= found for found in doubted)
    likelier = without_runs(rival)
    assert likelier.cost < rival.cost
    assert (likelier.pose.solved.places.right[members] < 0.5).all()


@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 3))])
def test_nothing_is_doubted_where_all_is_right(seed: int) -> None:
    pose = pose_mode(graph_of(simulated(seed)))
    rival = Rival(pose.problem.mode, estimate_poses(pose.problem, hold=True, start=PoseStart.at(pose)))
    assert without_runs(rival) is rival


@torch.no_grad()
@pytest.mark.parametrize("seed", [0, *(pytest.param(seed, marks=pytest.mark.large) for seed in range(1, 2))])
def test_what_a_run_has_in_common_is_what_all_other_rows_say(seed: int) -> None:
    """By dense normal equations without the run's own row."""
    pose = pose_mode(graph_of(simulated(seed)))
    problem, solved = pose.problem, pose.solved
    d, num_edges = problem.turns + problem.shifts, len(problem.drawn.source)
    turn_weight, state = solved.rotation_weight, pose.state
    root = whitening(problem, solved.covariance, turn_weight, solved.closure_root, state)
    rows = np.matmul(root, jacobian(problem, solved.arms))
    place = problem.equations.block
    dense = np.zeros((len(rows), d, problem.equations.num_blocks, d))
    for third in range(3):
        used = np.flatnonzero(place[:, third] >= 0)
        dense[used, :, place[used, third]] += rows[used, :, third * d : (third + 1) * d]
    dense = dense.reshape(len(rows), d, -1)
    tied = np.zeros((problem.equations.num_blocks, d))
    tied[problem.drawn.roots] = root_weight(problem, turn_weight, state)
    step = solved.factor.fit(solved.left)
    square = unlikely_offsets(pose)
    for run in range(problem.num_runs):
        others = np.delete(np.arange(len(rows)), num_edges + run)
        kept = dense[others].reshape(-1, dense.shape[2])
        normal = kept.T @ kept + np.diag(tied.ravel())
        own = dense[num_edges + run]
        # What is left of a row is its residual less what the step explains of it.
        residual = solved.left + (dense @ step.reshape(-1))[:, :, None]
        fitted = np.linalg.solve(normal, kept.T @ residual[others].reshape(-1))
        off = residual[num_edges + run, :, 0] - own @ fitted
        covariance = own @ np.linalg.solve(normal, own.T) + np.eye(d)
        np.testing.assert_allclose(square[run], off @ np.linalg.solve(covariance, off), rtol=1e-4, atol=1e-6)


def test_closures_that_somebody_knows_of_are_never_doubted() -> None:
    """Nor those of which no place is known."""
    rival, members = bent(0)
    pose = rival.pose
    for changed in (
        replace(pose.problem.told, label=np.ones(len(pose.problem.told.label))),
        replace(pose.problem.told, is_known=np.zeros(len(pose.problem.told.label), dtype=bool)),
    ):
        problem = replace(pose.problem)
        problem.__dict__["told"] = changed
        assert runs_to_doubt(replace(pose, problem=problem)) == []
    assert len(members) > 0


def test_without_the_switch_nothing_is_doubted() -> None:
    rival, _ = bent(0)
    mode = rival.mode
    problem = replace(mode.problem, without=frozenset({"doubted-runs"}))
    assert without_runs(replace(rival, mode=replace(mode, problem=problem))).pose is rival.pose
