"""Odometry whose steps err alike, however long they are, and closures with few or many translations in the tails."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics.positions import position_errors
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.poses.closures import GOOD, TAILS
from rotavg_ros.solver.slam.poses.em.noise import _likeliest_parts
from rotavg_ros.view_graph import ViewGraph

from .test_poses import pose_mode

TURN, SHIFT, CLOSURE = np.radians(0.5), 0.1, 0.05
# Variance of closures in the tails, relative to that of others.
TAIL = 16.0


def laps(
    seed: int, *, by_length: bool = False, shift: float = SHIFT, tails: float = 0.0
) -> tuple[ViewGraph, np.ndarray]:
    """Five laps of a circle of 20 m by steps of .2 to 8 m, a closure to the lap before at each; and the truth.

    Args:
        by_length: whether the variance of odometry is in proportion to the step's length, not alike.
        shift: metres that odometry errs by a step, in the root mean square.
        tails: share of closures in the tails.
    """
    rng = np.random.default_rng(seed)
    step = np.exp(rng.uniform(np.log(0.2), np.log(8.0), 320))
    along = np.concatenate((np.zeros(1), np.cumsum(step))) * (5 * 2 * np.pi * 20 / step.sum())
    angle = along / 20
    position = 20 * np.stack((np.cos(angle), np.sin(angle), np.zeros_like(angle)), axis=1)
    world_from_body = Rotation.from_rotvec(np.outer(angle + np.pi / 2, [0.0, 0.0, 1.0]))
    newer = np.flatnonzero(angle > 2 * np.pi)
    older = np.searchsorted(angle, angle[newer] - 2 * np.pi)
    source = np.concatenate((np.arange(len(angle) - 1), older))
    target = np.concatenate((np.arange(1, len(angle)), newer))
    is_closure = np.arange(len(source)) >= len(angle) - 1
    way = world_from_body[source].inv().apply(position[target] - position[source])
    length = np.linalg.norm(way, axis=1)
    sigma = np.where(by_length, np.sqrt(length / length[~is_closure].mean()), 1.0) * shift
    wide = np.where(rng.random(len(source)) < tails, np.sqrt(TAIL), 1.0)
    sigma[is_closure] = (CLOSURE * wide)[is_closure]
    way[:, :2] += sigma[:, None] * rng.normal(size=(len(source), 2))
    turn = Rotation.from_rotvec(np.outer(rng.normal(0, TURN, len(source)), [0.0, 0.0, 1.0]))
    relative = turn * world_from_body[target].inv() * world_from_body[source]
    kind = is_closure.astype(np.int64)
    return ViewGraph.create(source, target, relative.as_quat(), kind=kind, translation=way), position


@pytest.mark.large
@torch.no_grad()
def test_what_a_step_errs_by_is_found() -> None:
    """Both parts of the variance, of odometry that errs by one of them alone."""
    for seed in range(3):
        by_steps, by_length = (pose_mode(laps(seed, by_length=each)[0]).state.noise for each in (False, True))
        assert by_steps.step == pytest.approx(SHIFT**2, rel=0.35)
        assert by_length.step < 0.05 * SHIFT**2
        mean_step = 5 * 2 * np.pi * 20 / 320
        assert by_length.way * mean_step == pytest.approx(SHIFT**2, rel=0.35)


@torch.no_grad()
def test_without_a_part_of_each_step_all_of_it_is_in_proportion_to_the_way() -> None:
    graph, _ = laps(0)
    pose = pose_mode(graph, without={"step-errors"})
    solved, segments = pose.solved, slice(pose.problem.drawn.num_segments)
    k = pose.problem.turns
    freedom = np.trace(solved.factor.redundancy[segments, k:, k:], axis1=1, axis2=2)
    assert (solved.left[segments, k:] ** 2).sum() / freedom.sum() == pytest.approx(1.0, abs=0.1)


@torch.no_grad()
def test_squares_far_above_their_prior_end_the_steps() -> None:
    """A prior that holds a variance far below its squares: the curvature there is that of the squares."""
    ones, priors = np.ones(20), [(0.0, 0.7)]

    def found(start: float) -> float:
        told = 400 / 20 * ones, 2 / 20 * ones
        return float(_likeliest_parts(told, np.exp(start) * ones, ones[:, None], np.array([start]), priors)[0])

    assert found(2.0) == pytest.approx(found(4.0), abs=1e-2)


@pytest.mark.large
def test_positions_are_better_by_it() -> None:
    ratio = []
    for seed in (0, 2, 3):
        graph, position = laps(seed)
        off = [position_errors(_solved(graph, method), position) for method in ("neurora", "neurora~step-errors")]
        ratio.append(np.sqrt((off[0] ** 2).mean() / (off[1] ** 2).mean()))
    assert np.exp(np.mean(np.log(ratio))) < 0.94


def _solved(graph: ViewGraph, method: str) -> np.ndarray:
    position = solve(graph, method=method).position
    assert position is not None
    return np.asarray(position)


@torch.no_grad()
@pytest.mark.parametrize("tails", [0.0, 0.1])
def test_tails_are_counted(tails: float) -> None:
    """Taken for as many as the prior says, closures would seem to err by less, or by more, than they do."""
    pose = pose_mode(laps(0, shift=0.01, tails=tails)[0])
    chance, noise = pose.solved.places.chance, pose.state.noise
    assert chance[TAILS].sum() / chance[:GOOD].sum() == pytest.approx(tails, abs=0.06)
    assert np.sqrt(noise.of_closures(0.0)) == pytest.approx(CLOSURE, rel=0.2)


def seen_again(
    seed: int, *, off: float = 0.0, relative: float = 0.0, ahead: float = 1.0, odometry: float = 0.01
) -> tuple[ViewGraph, np.ndarray]:
    """Four laps of a circle of 10 m by steps of a metre, closures to a lap before, up to ``off`` metres aside.

    Closures err by :data:`CLOSURE`, and by a share ``relative`` of their length, by ``ahead`` times as much along the
    circle; odometry by some metres a step. Second: the truth.
    """
    rng = np.random.default_rng(seed)
    lap = 63
    angle = 2 * np.pi / lap * np.arange(4 * lap)
    radius = 10 + off * (np.arange(4 * lap) // lap) * (1 - np.cos(angle)) / 2
    position = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle)), axis=1)
    world_from_body = Rotation.from_rotvec(np.outer(angle, [0.0, 0.0, 1.0]))
    newer = np.arange(lap, 4 * lap)
    source = np.concatenate((np.arange(4 * lap - 1), newer - lap))
    target = np.concatenate((np.arange(1, 4 * lap), newer))
    is_closure = np.arange(len(source)) >= 4 * lap - 1
    way = world_from_body[source].inv().apply(position[target] - position[source])
    sigma = np.where(is_closure, np.hypot(CLOSURE, relative * np.linalg.norm(way, axis=1)), odometry)
    way[:, :2] += sigma[:, None] * rng.normal(size=(len(source), 2)) * np.where(is_closure[:, None], [1.0, ahead], 1.0)
    turn = Rotation.from_rotvec(np.outer(rng.normal(0, np.radians(0.1), len(source)), [0.0, 0.0, 1.0]))
    rotation = turn * world_from_body[target].inv() * world_from_body[source]
    kind = is_closure.astype(np.int64)
    return ViewGraph.create(source, target, rotation.as_quat(), kind=kind, translation=way), position


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_a_length_that_is_an_error_does_not_explain_it(seed: int) -> None:
    """Of closures from places to themselves, some are off by twenty times what the others err by."""
    graph, _ = seen_again(seed)
    assert graph.translation is not None
    off = torch.nonzero(~graph.is_odometry)[10::20, 0]
    way = graph.translation.clone()
    way[off, 0] += 20 * CLOSURE
    pose = pose_mode(replace(graph, translation=way))
    is_off = torch.isin(torch.from_numpy(pose.problem.closures), off).numpy()
    right = pose.solved.places.right
    assert right[is_off].max() < 0.1
    assert np.median(right[~is_off]) > 0.9


@torch.no_grad()
@pytest.mark.parametrize("seed", range(3))
def test_errors_in_proportion_to_the_length_are_found(seed: int) -> None:
    """As large as those of a front end that rather measures directions."""
    noise = pose_mode(seen_again(seed, off=4.0, relative=0.6)[0]).state.noise
    assert np.sqrt(noise.relative) == pytest.approx(0.6, rel=0.2)
