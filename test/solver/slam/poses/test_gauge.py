"""No row of the joint system tells how everything, or a robot that nothing joins, is turned or where it lies."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros.solver.slam.poses.rows import Arms, jacobian
from rotavg_ros.view_graph import EdgeKind, ViewGraph

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


def test_nothing_predicts_the_only_closure_that_joins_a_robot() -> None:
    """Residuals of the robot's own odometry seemed to hold it to 23° and less."""
    town = in_a_town(0, good=1)
    first, second = (town.graph.source < LENGTH, town.graph.target < LENGTH)
    joins = (first != second) & torch.from_numpy(~town.is_false)
    kept = (first == second) | joins
    graph: ViewGraph = town.graph.select_edges(kept)
    assert ((graph.kind == EdgeKind.LOOP_CLOSURE) & ((graph.source < LENGTH) != (graph.target < LENGTH))).sum() == 1
    pose = pose_mode(graph)
    join = np.flatnonzero(~pose.problem.within_chain)
    np.testing.assert_allclose(pose.solved.factor.redundancy[pose.problem.mode.problem.closure[join]], 0.0, atol=1e-6)
