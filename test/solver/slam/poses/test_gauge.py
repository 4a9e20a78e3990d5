"""No row of the joint system tells how everything, or a robot that nothing joins, is turned or where it lies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import solve
from rotavg_ros.solver.slam.poses.rows import Arms, jacobian
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

from .test_joins import LENGTH, in_a_town
from .test_poses import HILLS, graph_of, pose_mode, simulated


@pytest.mark.parametrize("options", [{}, HILLS], ids=["plane", "hills"])
def test_a_turn_of_everything_changes_no_row(options: dict[str, object]) -> None:
    pose = pose_mode(graph_of(simulated(1, num_keyframes=120, false_share=0.2, **options)))
    problem, state = pose.problem, pose.state
    turns, shifts = problem.bases
    drawn, d = problem.drawn, problem.turns + problem.shifts
    arms = Arms.of(problem, state, problem.displacements(problem.orientations(state)))
    rows = jacobian(problem, arms)[: len(drawn.source)]
    for axis in turns.T:
        moved = np.concatenate(
            (np.tile(axis @ turns, (drawn.num_nodes, 1)), np.cross(state.position, axis) @ shifts), 1
        )
        for part, node in ((slice(d), drawn.target), (slice(d, 2 * d), drawn.source)):
            assert np.abs(np.einsum("eij,ej->ei", rows[:, :, part], moved[node])).max() > 0.1
        change = np.einsum("eij,ej->ei", rows[:, :, :d], moved[drawn.target])
        change += np.einsum("eij,ej->ei", rows[:, :, d : 2 * d], moved[drawn.source])
        np.testing.assert_allclose(change, 0.0, atol=1e-9 * np.abs(state.position).max())


def joined_by_one_closure() -> ViewGraph:
    town = in_a_town(0, good=1)
    return town.graph.select_edges(torch.from_numpy(~town.is_false))


def between_robots(graph: ViewGraph) -> np.ndarray:
    """The edges ``(n,)`` that join two robots."""
    return np.flatnonzero((graph.source < LENGTH) != (graph.target < LENGTH))


def test_nothing_predicts_the_only_closure_that_joins_a_robot() -> None:
    """Residuals of the robot's own odometry seemed to hold it to 23° and less."""
    graph = joined_by_one_closure()
    assert len(between_robots(graph)) == 1
    pose = pose_mode(graph)
    join = np.flatnonzero(~pose.problem.within_chain)
    np.testing.assert_allclose(pose.solved.factor.redundancy[pose.problem.mode.problem.closure[join]], 0.0, atol=1e-6)


def test_a_robot_whose_only_join_is_rejected_is_anywhere_on_the_map() -> None:
    """It was stated to 20° and a kilometre, and without residuals that hold it would be to a hundred turns."""
    graph = joined_by_one_closure()
    label = graph.label.clone()
    label[between_robots(graph)] = int(EdgeLabel.REJECTED)
    solution = solve(replace(graph, label=label))
    assert solution.position is not None and solution.position_uncertainty is not None
    turn, shift = solution.uncertainty[LENGTH:].numpy(), solution.position_uncertainty[LENGTH:].numpy()
    spread = float(np.var(solution.position.numpy()[:, :2], axis=0).mean()) ** 0.5
    assert (turn > np.pi / 2).all() and (turn < np.pi).all()
    assert (shift > spread).all() and (shift < 5 * spread).all()


def test_the_only_closure_that_joins_a_robot_is_false_as_often_as_others() -> None:
    """And the robot is known no better than that. Its score was .01, however many others were false."""
    before, rng, count = joined_by_one_closure(), np.random.default_rng(0), 30
    first = LENGTH * rng.integers(0, 2, count)
    source, target = first + rng.integers(0, LENGTH // 2, count), first + rng.integers(LENGTH // 2, LENGTH, count)
    turn = Rotation.from_rotvec(np.outer(rng.uniform(-np.pi, np.pi, count), [0, 0, 1.0]))
    assert before.translation is not None
    graph = ViewGraph.create(
        np.r_[before.source, source],
        np.r_[before.target, target],
        target_from_source=np.r_[before.target_from_source.numpy(), turn.as_quat()],
        translation=np.r_[before.translation.numpy(), np.c_[rng.normal(0, 1, (count, 2)), np.zeros(count)]],
        kind=np.r_[before.kind.numpy(), np.full(count, EdgeKind.LOOP_CLOSURE)],
        num_nodes=before.num_nodes,
    )
    solution = solve(graph)
    score, closures = solution.outlier_score.numpy(), int((graph.kind == EdgeKind.LOOP_CLOSURE).sum())
    assert (score[-count:] > 0.9).sum() > 0.9 * count
    (join,) = between_robots(graph)
    assert 0.5 * count / closures < score[join] < 1.5 * count / closures
    assert np.degrees(float(solution.uncertainty[LENGTH:].min())) > 20
