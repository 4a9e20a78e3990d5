"""A part of a robot's way turns with the robots that closures hang on it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros import ViewGraph
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.slips import propose_mending
from rotavg_ros.solver.slam.posterior.moves.turning import part_turned
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from test.solver.slam.posterior.planar import planar, problem_of, state_of, yaw

LENGTH, MIDDLE, TURN_DEG = 60, 30, 70.0
BEFORE, AFTER, FARTHER = 1, 2, 3  # robots: seen before the middle of the first one's way, after it, and by AFTER


def fleet(seed: int, order: tuple[int, int, int, int] = (0, 1, 2, 3)) -> ViewGraph:
    """Four planar robots that head the same way, numbered in some order; the first one has loops across its middle."""
    rng = np.random.default_rng(seed)
    edges: list[tuple[int, int, float, int]] = []

    def add(one: int, i: int, other: int, j: int, noise_deg: float, is_closure: int) -> None:
        edges.append((order[one] * LENGTH + i, order[other] * LENGTH + j, rng.normal(0, noise_deg), is_closure))

    for robot in range(4):
        for i in range(LENGTH - 1):
            add(robot, i, robot, i + 1, 0.3, 0)
    for start, stop in ((0, 24), (MIDDLE + 4, LENGTH - 2)):
        for i, j in zip(range(start, stop, 4), range(start + 8, stop, 4), strict=False):
            add(0, i, 0, j, 1.0, 1)
    for i in range(4):
        add(0, 2 + 5 * i, 0, MIDDLE + 6 + 5 * i, 1.0, 1)
        add(0, 1 + 7 * i, BEFORE, 12 * i, 1.0, 1)
        add(0, MIDDLE + 3 + 7 * i, AFTER, 12 * i, 1.0, 1)
        add(AFTER, 3 + 11 * i, FARTHER, 12 * i, 1.0, 1)
    source, target, off, kind = zip(*edges, strict=True)
    return ViewGraph.create(source, target, yaw(np.radians(off)), num_nodes=4 * LENGTH, kind=kind)


def middle(mode: Mode, robot: int) -> int:
    """The segment of a robot's way that passes its middle."""
    graph = mode.problem.graph
    node = robot * LENGTH + MIDDLE
    first, last = np.sort(graph.nodes[np.stack((graph.source, graph.target))], axis=0)
    (segment,) = np.flatnonzero(graph.is_odometry & (first <= node) & (node < last))
    return int(segment)


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (3, 1, 2, 0)])
def test_only_what_crosses_the_slip_sees_the_turn(order: tuple[int, int, int, int]) -> None:
    problem = problem_of(fleet(0, order), SlamPriors())
    mode = Search(problem).polished(state_of(problem, np.zeros(len(problem.closure), dtype=bool)), "truth")
    graph, turn = problem.graph, yaw(np.radians([TURN_DEG])).T
    segment = middle(mode, order[0])
    state = part_turned(mode, graph.behind(segment), turn)
    before, after = (
        quaternion_rows.residual_vectors(each.correction, problem.measured, graph.source, graph.target)
        for each in (mode.state, state)
    )
    behind = graph.behind(segment)
    of_first = graph.nodes // LENGTH == order[0]
    crosses = (of_first[graph.source] & of_first[graph.target]) & (behind[graph.source] != behind[graph.target])
    np.testing.assert_allclose(after[~crosses], before[~crosses], atol=1e-9)
    changed = np.degrees(np.linalg.norm(after[crosses] - before[crosses], axis=1))
    assert crosses.sum() == 5
    np.testing.assert_allclose(changed, TURN_DEG, atol=1e-6)
    np.testing.assert_array_equal(state.correction[:, graph.roots], mode.state.correction[:, graph.roots])


@pytest.mark.parametrize("order", [(0, 1, 2, 3), (2, 3, 0, 1), (3, 1, 2, 0)])
@pytest.mark.parametrize("seed", range(3))
def test_a_slip_that_never_was_is_taken_back_with_the_robots_beyond_it(
    seed: int, order: tuple[int, int, int, int]
) -> None:
    problem = problem_of(fleet(seed, order), SlamPriors())
    search = Search(problem)
    right = search.polished(state_of(problem, np.zeros(len(problem.closure), dtype=bool)), "truth")
    segment, turn = middle(right, order[0]), yaw(np.radians([TURN_DEG])).T
    graph, behind = problem.graph, problem.graph.behind(middle(right, order[0]))
    trusted = right.state.trusted.copy()
    trusted[segment] = 0.0
    of_first = graph.nodes // LENGTH == order[0]
    crosses = (of_first[graph.source] & of_first[graph.target]) & (behind[graph.source] != behind[graph.target])
    trusted[crosses] = 0.0
    wrong = search.polished(replace(part_turned(right, behind, turn), trusted=trusted), "slipped")
    assert list(wrong.slipped) == [segment] and wrong.cost > right.cost + 10
    proposals = [each for each in propose_mending(wrong) if each.predicted <= each.slack]
    found = min((search.polished(each.make(), each.name) for each in proposals), key=lambda mode: mode.cost)
    assert found.cost == pytest.approx(right.cost, abs=0.5)
    assert not found.is_false.any() and len(found.slipped) == 0


def test_a_robot_alone_turns_by_itself() -> None:
    problem = problem_of(planar(0, 12, 0.3)[0], SlamPriors())
    mode = Search(problem).polished(state_of(problem, np.zeros(12, dtype=bool)), "truth")
    behind, turn = problem.graph.behind(3), yaw(np.array([0.7])).T
    state = part_turned(mode, behind, turn)
    np.testing.assert_array_equal(state.correction[:, ~behind], mode.state.correction[:, ~behind])
    expected = quaternion_rows.multiply(mode.state.correction[:, behind], turn)
    np.testing.assert_array_equal(state.correction[:, behind], expected)
