"""Whole runs of closures that are believed after all, or doubted."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros.solver.slam.poses.estimate import PoseMode, PoseStart, estimate_poses
from rotavg_ros.solver.slam.poses.search.runs import runs_to_believe, runs_to_doubt, without_runs
from rotavg_ros.solver.slam.poses.search.settling import Rival

from .test_floors import building
from .test_poses import graph_of, pose_mode, simulated


def doubted(pose: PoseMode) -> tuple[PoseMode, np.ndarray]:
    """The same where the longest run is held to join wrong places, all of it; and its closures."""
    problem, places = pose.problem, pose.solved.places
    right = places.right > 0.5
    run = int(np.argmax(np.bincount(problem.told.run, right)))
    members = np.flatnonzero(right & (problem.told.run == run))
    start = PoseStart.at(pose)
    chance, weight, turn = places.chance.copy(), places.weight.copy(), places.rotation_weight.copy()
    chance[:, members] = 0.0
    chance[-2, members] = 1.0
    weight[members] *= 1e-8
    turn[members] *= 1e-8
    start = replace(start, places=replace(places, chance=chance, weight=weight, rotation_weight=turn), solves=1)
    return estimate_poses(problem, start=start), members


@pytest.mark.parametrize("seed", [1, 2, 5])
def test_a_run_that_is_right_is_likelier_to_be(seed: int) -> None:
    pose = pose_mode(graph_of(simulated(seed)))
    without, members = doubted(pose)
    gained = {tuple(found): nats for nats, found in runs_to_believe(without)}
    best = max(gained, key=lambda found: len(set(found) & set(members.tolist())))
    assert set(best) & set(members.tolist())
    assert gained[best] > 0
    believed = estimate_poses(pose.problem, start=PoseStart.believing(without, np.array(best)))
    assert (believed.solved.places.right[list(best)] > 0.5).all()


@pytest.mark.parametrize("seed", range(3))
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


@pytest.mark.parametrize("seed", range(3))
def test_a_run_that_bends_the_map_is_doubted(seed: int) -> None:
    rival, members = bent(seed)
    assert (rival.pose.solved.places.right[members] > 0.5).all()
    doubted = [set(found.tolist()) for found in runs_to_doubt(rival.pose)]
    assert any(set(members.tolist()) <= found for found in doubted)
    likelier = without_runs(rival)
    assert likelier.cost < rival.cost
    assert (likelier.pose.solved.places.right[members] < 0.5).all()


@pytest.mark.parametrize("seed", range(3))
def test_nothing_is_doubted_where_all_is_right(seed: int) -> None:
    pose = pose_mode(graph_of(simulated(seed)))
    rival = Rival(pose.problem.mode, estimate_poses(pose.problem, hold=True, start=PoseStart.at(pose)))
    assert without_runs(rival) is rival
