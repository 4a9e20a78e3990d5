"""Closures that are false by the same turn of the map, wherever they are seen from and however they are written."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.slam import pose_cases
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.poses.closures import Predictions
from rotavg_ros.solver.slam.poses.em.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.posterior.solve import search
from rotavg_ros.solver.slam.stages import bootstrap
from rotavg_ros.view_graph import ViewGraph

# So far from the true place at least, metres.
_ELSEWHERE_M = 4.0


def symmetric(world: str, seed: int) -> Case:
    name = f"{world}: 30 % symmetric building"
    (kind,) = (kind for kind in pose_cases.kinds(Path, [name]) if kind.name == name)
    case = kind.draw(seed)
    assert case is not None
    return case


def posed(graph: ViewGraph) -> PoseMode:
    assert graph.translation is not None
    with torch.no_grad():
        mode = search(graph, load_network(SlamCleanNet), bootstrap).modes[0]
        return estimate_poses(PoseProblem(graph, graph.translation.numpy(), mode), hold=True)


def reversed_closures(graph: ViewGraph, rng: np.random.Generator) -> ViewGraph:
    """Half of the closures written from their other end."""
    assert graph.translation is not None
    other = ~graph.is_odometry & torch.from_numpy(rng.random(graph.num_edges) < 0.5)
    inverse = rotations.inverse(graph.target_from_source)
    back = -rotations.rotate(graph.target_from_source, graph.translation)
    return replace(
        graph,
        source=torch.where(other, graph.target, graph.source),
        target=torch.where(other, graph.source, graph.target),
        target_from_source=torch.where(other[:, None], inverse, graph.target_from_source),
        translation=torch.where(other[:, None], back, graph.translation),
    )


@pytest.fixture(scope="module", params=["building", "hills"])
def case_and_pose(request: pytest.FixtureRequest) -> tuple[Case, PoseMode]:
    """In a plane, and in space."""
    case = symmetric(request.param, 3)
    return case, posed(case.graph)


def repeats(pose: PoseMode, *, in_order: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """With those that are held false as the ones that tell."""
    solved, problem = pose.solved, pose.problem
    false = problem.mode.is_false & (np.linalg.norm(solved.maps.shift, axis=1) > _ELSEWHERE_M)
    alone = np.full(len(false), -np.log(2 * np.pi * solved.scale.extent))
    anybody = np.ones(len(false), dtype=bool)
    chance, by_width = solved.maps.repeats(false.astype(np.float64), alone, problem.told, anybody, in_order=in_order)
    return chance, by_width.mean(axis=1)


def test_those_turned_about_the_middle_of_the_map_tell_of_each_other(case_and_pose: tuple[Case, PoseMode]) -> None:
    case, pose = case_and_pose
    off = pose.problem.mode.is_false & (np.linalg.norm(pose.solved.maps.shift, axis=1) > _ELSEWHERE_M)
    assert case.intact is not None and off.sum() > 20
    assert not case.intact.numpy()[pose.problem.closures][off].any()
    chance, density = repeats(pose)
    anywhere = 1 / (2 * np.pi * pose.solved.scale.extent) ** (pose.problem.shifts / 2)
    assert np.median(density[off]) > 30 * anywhere
    assert np.median(chance[off]) > 0.9
    # A good closure is turned like none of them.
    assert chance[~pose.problem.mode.is_false].max() < 1e-3


def test_the_first_one_is_told_of_by_nobody_before(case_and_pose: tuple[Case, PoseMode]) -> None:
    _, pose = case_and_pose
    chance, density = repeats(pose, in_order=True)
    order = pose.problem.told.detection
    off = (pose.problem.mode.is_false & (np.linalg.norm(pose.solved.maps.shift, axis=1) > _ELSEWHERE_M))[order]
    first = order[np.flatnonzero(off)[0]]
    assert chance[first] == 0 and density[first] == 0
    assert repeats(pose)[0][first] > 0


def test_density_is_one_over_all_places(case_and_pose: tuple[Case, PoseMode]) -> None:
    """Of a closure that may be off by any shift, and is turned like some: what is said of its shift adds up."""
    _, pose = case_and_pose
    maps, told = pose.solved.maps, pose.problem.told
    off = np.flatnonzero(pose.problem.mode.is_false & (np.linalg.norm(maps.shift, axis=1) > _ELSEWHERE_M))
    chance, _ = repeats(pose)
    one = off[np.argmax(chance[off])]
    false = np.zeros(len(maps.shift))
    false[off] = 1.0
    false[one] = 0.0  # else it would tell others, who are what it is told by
    alone = np.full(len(false), -np.log(2 * np.pi * pose.solved.scale.extent))
    rng, reach, draws = np.random.default_rng(0), 60.0, 40_000
    axes = maps.bases[1]
    away = rng.uniform(-reach, reach, (draws, axes.shape[1]))
    count = len(false)
    copies = np.concatenate((np.arange(count), np.full(draws, one)))
    many = replace(
        maps,
        turn=maps.turn[:, copies],
        shift=np.concatenate((maps.shift, away @ axes.T)),
        place=maps.place[copies],
        covariance=maps.covariance[copies] * np.where(np.arange(count + draws) < count, 1.0, 900.0)[:, None, None],
    )
    # As many as may be told of at once: all of them right after the last.
    told = replace(
        told,
        is_known=np.concatenate((told.is_known, np.ones(draws, dtype=bool))),
        detection=np.concatenate((told.detection, np.arange(count, count + draws))),
        detected=np.concatenate((told.detected, np.arange(count, count + draws))),
    )
    anybody = np.ones(count + draws, dtype=bool)
    chance, density = many.repeats(
        np.concatenate((false, np.zeros(draws))),
        np.concatenate((alone, np.full(draws, -50.0))),  # a map so large that no kernel covers much of it
        told,
        anybody,
        in_order=False,
    )
    assert chance[-1] > 0.5
    # Of the broader kernels many draws tell, of the narrower ones some do in space.
    total = density[count:].mean(axis=0) * (2 * reach) ** axes.shape[1]
    assert total[-1] == pytest.approx(chance[-1], rel=0.1)
    assert total.mean() == pytest.approx(chance[-1], rel=0.15)


def test_whichever_end_a_closure_is_written_from(case_and_pose: tuple[Case, PoseMode]) -> None:
    case, pose = case_and_pose
    other = posed(reversed_closures(case.graph, np.random.default_rng(1)))
    np.testing.assert_array_equal(pose.problem.mode.is_false, other.problem.mode.is_false)
    for in_order in (False, True):
        (chance, density), (chance_other, density_other) = (repeats(each, in_order=in_order) for each in (pose, other))
        # Variances come from samples, which are others then.
        assert np.quantile(np.abs(chance_other - chance), 0.95) < 0.1
        told = density > 1e-3
        assert told.any()
        assert np.median(np.abs(np.log(density_other[told] / density[told]))) < 0.2


def test_turns_of_the_map_are_known_as_well_from_either_end(case_and_pose: tuple[Case, PoseMode]) -> None:
    """What is predicted of a closure is as uncertain whichever end it is written from: only its sign differs."""
    _, pose = case_and_pose
    problem, position, count = pose.problem, pose.state.position, len(pose.problem.closures)
    rng, size = np.random.default_rng(0), problem.turns + problem.shifts
    mean, root = rng.normal(size=(count, size)), rng.normal(size=(count, size, size))
    noise = np.tile(np.eye(problem.shifts), (count, 1, 1))
    told, drawn = problem.told, problem.drawn
    back: Any = SimpleNamespace(
        mode=problem.mode,
        bases=problem.bases,
        drawn=SimpleNamespace(source=drawn.target, target=drawn.source),
        told=replace(told, sign=-told.sign),
    )
    first, second = (
        MapTurns.of(each, position, Predictions(sign * mean, root @ root.transpose(0, 2, 1)), noise, 0.1)
        for each, sign in ((problem, 1.0), (back, -1.0))
    )
    for name in ("turn", "shift", "place", "covariance", "own"):
        np.testing.assert_allclose(getattr(second, name), getattr(first, name), rtol=0, atol=1e-12)
