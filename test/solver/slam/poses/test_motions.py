"""How closures between robots would move one of them: against SciPy, and whichever end they are stated from."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.solver.slam.poses.search.motions import Motions
from rotavg_ros.solver.slam.poses.solved import PoseMode

from .test_even_shifts import of_camera
from .test_joins import LENGTH, Streets, in_a_town, placed_by_false

TURNED_DEG = 25.0


@pytest.fixture(scope="module")
def streets() -> Streets:
    return in_a_town(0, turned_deg=TURNED_DEG)


def joins_of(pose: PoseMode, streets: Streets) -> tuple[np.ndarray, np.ndarray]:
    """Closures between the robots, and which of them are false."""
    joins = np.flatnonzero(~pose.problem.within_chain)
    return joins, streets.is_false[pose.problem.closures[joins]]


def test_motions_are_those_of_the_poses_that_closures_state(streets: Streets) -> None:
    pose = placed_by_false(streets).pose
    joins, _ = joins_of(pose, streets)
    motions, graph, drawn = Motions.of(pose, joins), pose.problem.graph, pose.problem.drawn
    assert graph.translation is not None
    position = np.zeros((graph.num_nodes, 3))
    position[drawn.nodes] = pose.state.position
    world_from_body = Rotation.from_quat(pose.problem.orientations(pose.state)).inv()
    edge = pose.problem.closures[joins]
    source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
    assert (source < LENGTH).all() and (target >= LENGTH).all()
    source_from_target = Rotation.from_quat(graph.target_from_source.numpy()[edge]).inv()
    stated = world_from_body[source] * source_from_target
    turn = stated * world_from_body[target].inv()
    np.testing.assert_allclose((Rotation.from_quat(motions.turn.T) * turn).magnitude(), 0.0, atol=1e-9)
    to = position[source] + world_from_body[source].apply(graph.translation.numpy()[edge])
    np.testing.assert_allclose(motions.at, position[target], atol=1e-12)
    np.testing.assert_allclose(motions.to, to, atol=0.01)  # displacements are those before the last step


def test_right_closures_agree_and_false_ones_with_each_other(streets: Streets) -> None:
    pose = placed_by_false(streets).pose
    joins, is_false = joins_of(pose, streets)
    agree = Motions.of(pose, joins).agree(pose.problem.turns, pose.problem.shifts)
    assert not agree[is_false[:, None] != is_false].any()
    assert agree[np.ix_(is_false, is_false)].all()
    assert agree[np.ix_(~is_false, ~is_false)].any(axis=0).all() and agree[~is_false][:, ~is_false].mean() > 0.8


@pytest.mark.parametrize("seed", range(3))
def test_motions_do_not_depend_on_the_end_that_edges_are_stated_from(streets: Streets, seed: int) -> None:
    backward = streets.joins & (np.random.default_rng(seed).random(len(streets.joins)) < 0.5)
    other = streets.graph.reverse_edges(torch.from_numpy(backward))
    there, here = (placed_by_false(each).pose for each in (streets, streets._replace(graph=other)))
    one, two = (Motions.of(pose, joins_of(pose, streets)[0]) for pose in (there, here))
    np.testing.assert_allclose(np.abs((one.turn * two.turn).sum(axis=0)), 1.0, atol=1e-7)
    np.testing.assert_allclose(one.to - one.at, two.to - two.at, atol=1e-3)
    np.testing.assert_array_equal(one.agree(1, 2), two.agree(1, 2))


@pytest.mark.parametrize("tilted", [False, pytest.param(True, marks=pytest.mark.large)])
def test_motions_do_not_depend_on_the_bodys_axes(streets: Streets, tilted: bool) -> None:
    """Nor on whether the robots stay in a plane: where one rolls a little at each step, all three axes are judged."""
    here = streets
    if tilted:
        rolls = np.radians(np.random.default_rng(0).normal(0, 0.3, len(streets.joins)))
        wobble = Rotation.from_rotvec(np.outer(rolls, [1, 0, 0]))
        turned = wobble * Rotation.from_quat(streets.graph.target_from_source.numpy())
        here = streets._replace(graph=replace(streets.graph, target_from_source=torch.from_numpy(turned.as_quat())))
    poses = [placed_by_false(each).pose for each in (here, here._replace(graph=of_camera(here.graph)))]
    assert all(pose.problem.turns == (3 if tilted else 1) for pose in poses)
    one, two = (Motions.of(pose, joins_of(pose, here)[0]) for pose in poses)
    turns = [2 * np.arccos(np.minimum(np.abs(each.turn[3]), 1.0)) for each in (one, two)]
    np.testing.assert_allclose(*turns, atol=1e-3)
    lengths = [np.linalg.norm(each.to - each.at, axis=1) for each in (one, two)]
    np.testing.assert_allclose(*lengths, atol=0.02)
    agree = [each.agree(pose.problem.turns, pose.problem.shifts) for each, pose in zip((one, two), poses, strict=True)]
    np.testing.assert_array_equal(*agree)
