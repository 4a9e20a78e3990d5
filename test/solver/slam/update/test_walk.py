"""What odometry since a solve errs by, against derivatives of composed poses and against whole solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.online.answer.gauge import extend_along_edges
from rotavg_ros.solver import solve
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.graph.walk import Dependence, Walk, common_walk
from rotavg_ros.solver.slam.poses.problem import crossing
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import ViewGraph

from .test_conditioned import drawn, first, turned_deg

SPACE = np.eye(3), np.eye(3)
PLANE = np.eye(3)[:, 2:], np.eye(3)[:, :2]


def chain(axes: np.ndarray, count: int) -> tuple[ViewGraph, np.ndarray, np.ndarray]:
    """Odometry along which ``count`` nodes hang on nodes 0 and 1 by turns; its turns and steps."""
    random = np.random.default_rng(0)
    turn = random.normal(0, 0.4, (count, axes.shape[1])) @ axes.T
    step = random.normal(0, 1.0, (count, 3))
    if axes.shape[1] == 1:
        step[:, 2] = 0.0
    target = np.arange(2, count + 2)
    graph = ViewGraph.create(target - 2, target, Rotation.from_rotvec(turn).inv().as_quat(), num_nodes=count + 2)
    return graph, turn, step


def poses(turn: np.ndarray, step: np.ndarray) -> tuple[Rotation, np.ndarray]:
    """world_from_body and positions of the nodes of :func:`chain`."""
    orientation, position = [Rotation.identity()] * 2, [np.zeros(3)] * 2
    for number in range(len(turn)):
        position.append(position[number] + orientation[number].apply(step[number]))
        orientation.append(orientation[number] * Rotation.from_rotvec(turn[number]))
    return Rotation.concatenate(orientation), np.array(position)


@pytest.mark.parametrize("bases", [SPACE, PLANE])
@pytest.mark.parametrize("at_once", [True, False])
def test_covariances_are_those_of_composed_errors(bases: tuple[np.ndarray, np.ndarray], at_once: bool) -> None:
    """Each step errs by itself; a residual depends on two nodes and on a displacement in the axes of one of them."""
    (turns, shifts), count = bases, 12
    graph, turn, step = chain(turns, count)
    random = np.random.default_rng(1)
    variance = random.uniform(0.5, 2.0, (2, count))
    orientation, position = poses(turn, step)
    walk = Walk.begin(2)
    for some in (slice(0, 12),) if at_once else (slice(0, 5), slice(5, 6), slice(6, 12)):
        known = replace(graph.select_edges(torch.arange(some.stop)), num_nodes=some.stop + 2)
        growth = Growth.of(known, np.arange(some.start, some.stop), some.start + 2)
        assert growth is not None
        walk = walk.along(growth, variance[:, some], position[: some.stop + 2])
    source, target, displacement = np.array([0, 3, 7, 4]), np.array([8, 12, 13, 12]), random.normal(0, 2.0, (4, 3))
    displacement = displacement @ shifts @ shifts.T

    def residuals(turn_error: np.ndarray, step_error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Changes of all nodes and of the closures' residuals, ``(N, d)`` and ``(n, d)``."""
        moved, place = poses(turn, step)
        rotation, spot = list(moved), place.copy()
        for number in range(count):
            bend = Rotation.from_rotvec(turn_error[number])
            spot[number + 2] = spot[number] + rotation[number].apply(step[number]) + step_error[number]
            rotation[number + 2] = bend * rotation[number] * Rotation.from_rotvec(turn[number])
        change = Rotation.concatenate(rotation) * orientation.inv()
        # Turns of body_from_world on the right.
        bent = -change.as_rotvec()
        nodes = np.hstack((bent @ turns, (spot - position) @ shifts))
        off = bent[target] - bent[source]
        stated = change[source].apply(displacement) - displacement
        shifted = (spot - position)[target] - (spot - position)[source] - stated
        return nodes, np.hstack((off @ turns, shifted @ shifts))

    small, parts = 1e-6, []
    for number in range(count):
        for kind, axes in enumerate((turns, shifts)):
            for axis in axes.T:
                errors = np.zeros((2, count, 3))
                errors[kind, number] = small * axis
                changed = residuals(*errors)
                parts.append([np.sqrt(variance[kind, number]) * each / small for each in changed])
    of_nodes, of_closures = (np.array(each) for each in zip(*parts, strict=True))
    matrices = crossing(turns, shifts).reshape(3, shifts.shape[1], turns.shape[1])
    lever = np.stack((np.zeros_like(displacement), -displacement))
    ends = Dependence(np.stack((target, source)), np.array([1.0, -1.0]), lever)
    found = common_walk(walk, matrices, ends, ends)
    np.testing.assert_allclose(found, np.einsum("exa,eyb->xayb", of_closures, of_closures), atol=1e-4)
    found = common_walk(walk, matrices, Dependence.on(np.arange(2, count + 2)), ends)
    np.testing.assert_allclose(found, np.einsum("exa,eyb->xayb", of_nodes[:, 2:], of_closures), atol=1e-4)
    k = turns.shape[1]
    told = [(of_nodes[:, 2:, part] ** 2).sum(axis=0).mean(axis=1) for part in (slice(k), slice(k, None))]
    np.testing.assert_allclose(walk.variances(matrices), told, atol=1e-4)


def without_late_closures(*, planar: bool, known: int, back: int) -> ViewGraph:
    """A robot that explores from keyframe ``known`` on, and sees nothing again before keyframe ``back``."""
    graph, _ = drawn(translations=True, planar=planar, seed=2)
    later = torch.maximum(graph.source, graph.target)
    return graph.select_edges(graph.is_odometry | (later < known) | (later >= back))


def test_where_nothing_is_seen_again_uncertainty_grows_as_in_a_whole_solve() -> None:
    """However many keyframes come between ticks; had been two to three times too small with one."""
    graph = without_late_closures(planar=True, known=300, back=1000)
    graph = first(graph, 500)
    begun = solve(first(graph, 300), profile="slam")
    told = []
    for step in (200, 5):
        solution = begun
        for count in range(300 + step, 501, step):
            grown = first(graph, count)
            start = extend_along_edges(solution.body_from_world, grown)
            solution = solve(grown, profile="slam", warm_start=start, memory=solution.memory)
            assert set(solution.stage_seconds) == {"update"}
        assert solution.position_uncertainty is not None
        told.append(solution.position_uncertainty.numpy())
    np.testing.assert_allclose(*told, rtol=1e-9)
    whole = solve(graph, profile="slam")
    assert whole.position_uncertainty is not None
    ratio = told[0][310:] / whole.position_uncertainty.numpy()[310:]
    np.testing.assert_allclose(ratio, 1.0, atol=0.15)


@pytest.mark.parametrize("planar", [True, pytest.param(False, marks=pytest.mark.large)])
def test_after_a_long_way_closures_bend_it_as_the_update_does(planar: bool) -> None:
    graph = first(without_late_closures(planar=planar, known=300, back=480), 495)
    before = solve(first(graph, 300), profile="slam")
    start, memory = extend_along_edges(before.body_from_world, graph), before.memory
    assert isinstance(memory, SlamMemory)
    quick = solve(graph, profile="slam", warm_start=start, memory=replace(memory, update_work=1e9), work=1e4)
    after = solve(graph, profile="slam", warm_start=start, memory=memory)
    assert quick.position is not None and after.position is not None and after.position_uncertainty is not None
    along = extend_along_edges(before.body_from_world, graph)
    missed = np.degrees(rotations.angle_between(along, after.body_from_world).numpy())[300:].mean()
    assert turned_deg(quick, after)[300:].mean() < 0.25 * missed
    off = (quick.position - after.position).norm(dim=1)[300:]
    assert float(off.mean()) < 0.5 * float(after.position_uncertainty[300:].mean())
