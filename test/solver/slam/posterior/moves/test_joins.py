"""Chains of odometry that closures alone join, and that false ones hold turned."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pytest

from rotavg_ros import ViewGraph
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.moves.joins import propose_joins
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from test.solver.slam.posterior.planar import planar, problem_of, state_of, yaw

LENGTH = 60


class Fleet(NamedTuple):
    """Planar robots that all head the same way; of each edge, which chains it joins, and whether it is false."""

    graph: ViewGraph
    ends: np.ndarray
    is_false: np.ndarray


def fleet(robots: int, false: tuple[int, int], seed: int) -> Fleet:
    """Each robot has ten loops and five scattered joins with the next one; three false ones of a run join a pair."""
    rng = np.random.default_rng(seed)
    source, target, off, kind = [], [], [], []

    def add(i: int, j: int, off_by: float, noise_deg: float, is_closure: int) -> None:
        source.append(i)
        target.append(j)
        off.append(off_by + rng.normal(0, np.radians(noise_deg)))
        kind.append(is_closure)

    for robot in range(robots):
        first = robot * LENGTH
        for i in range(first, first + LENGTH - 1):
            add(i, i + 1, 0.0, 0.5, 0)
        for i in rng.integers(0, LENGTH - 20, 10):
            add(first + i, first + i + rng.integers(10, 20), 0.0, 1.5, 1)
        for i, j in rng.integers(0, LENGTH, (5 * (robot + 1 < robots), 2)):
            add(first + i, first + LENGTH + j, 0.0, 1.5, 1)
    for step in range(3):
        add(false[0] * LENGTH + 20 + step, false[1] * LENGTH + 35 + step, 1.5, 1.5, 1)
    graph = ViewGraph.create(source, target, yaw(np.array(off)), num_nodes=robots * LENGTH, kind=kind)
    return Fleet(graph, np.stack((source, target)) // LENGTH, np.abs(off) > 1)


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize(
    ("robots", "false", "contradicted"),
    [(2, (0, 1), (0, 1)), (3, (0, 2), (1, 2)), (4, (0, 2), (0, 1)), (4, (1, 3), (2, 3))],
)
def test_a_chain_turns_as_most_of_its_joins_say(
    robots: int, false: tuple[int, int], contradicted: tuple[int, int], seed: int
) -> None:
    """False joins hold a chain turned, and the good ones between two chains that contradict them are held false."""
    drawn = fleet(robots, false, seed)
    problem = problem_of(drawn.graph, SlamPriors())
    edge = problem.graph.view_graph_edge[problem.closure - problem.graph.num_segments]
    is_false, ends = drawn.is_false[edge], drawn.ends[:, edge]
    held = (ends == np.array(contradicted)[:, None]).all(axis=0) & ~is_false
    search = Search(problem)
    wrong = search.polished(state_of(problem, held), "wrong")
    proposals = [each for each in propose_joins(wrong) if each.predicted <= each.slack]
    found = min(
        (search.flipped(search.polished(each.make(), each.name)) for each in proposals), key=lambda mode: mode.cost
    )
    np.testing.assert_array_equal(found.is_false, is_false)
    right = search.polished(state_of(problem, is_false), "truth")
    assert found.cost < wrong.cost
    assert found.cost == pytest.approx(right.cost, abs=1.0)
    # From there no turn of a chain is promising enough to lower F.
    assert all(
        search.polished(each.make(), each.name).cost > found.cost - 0.1
        for each in propose_joins(found)
        if each.predicted <= each.slack
    )


def test_one_chain_has_none() -> None:
    graph, off = planar(0, 8, 0.5)
    problem = problem_of(graph)
    assert not list(propose_joins(Search(problem).polished(state_of(problem, off != 0), "truth")))
