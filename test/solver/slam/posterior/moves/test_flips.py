"""Closures that are believed together."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.flips import flipped
from rotavg_ros.view_graph import ViewGraph

from ..planar import problem_of, state_of, yaw


def test_closures_that_only_each_other_make_false_are_believed_together() -> None:
    """Three good ones 4° off: as false ones they repeat each other's turn, so that each by itself stays false."""
    rng = np.random.default_rng(0)
    count, older = 240, np.arange(0, 100, 4)
    off = np.radians(rng.normal(0, 1.5, len(older)))
    doubted = np.arange(1, 13, 4)
    off[doubted] = np.radians(4.0) + np.radians(rng.normal(0, 0.2, len(doubted)))
    graph = ViewGraph.create(
        np.concatenate((np.arange(count), older)),
        np.concatenate((np.arange(1, count + 1), older + 120)),
        yaw(np.concatenate((np.radians(rng.normal(0, 0.05, count)), off))),
        num_nodes=count + 1,
        kind=[0] * count + [1] * len(older),
    )
    problem = problem_of(graph)
    is_false = np.isin(np.arange(len(older)), doubted)
    mode = Mode(problem, *polish(problem, state_of(problem, is_false)), "test")
    assert (mode.left_out.log_odds[problem.closure[doubted]] < 0).all()
    believed = flipped(mode)
    assert not believed.is_false.any()
    assert believed.cost < mode.cost - 5


def test_closures_that_alone_join_two_parts_are_believed_together() -> None:
    """Each by itself tells nothing: its log-odds are those of the labels of the others, all false."""
    rng = np.random.default_rng(1)
    length, joins = 30, 12
    chain = np.concatenate((np.arange(length - 1), length + np.arange(length - 1)))
    ends = rng.permutation(length)[:joins], length + rng.permutation(length)[:joins]
    angle = np.concatenate((rng.normal(0, np.radians(0.1), len(chain)), rng.normal(0, np.radians(1.5), joins)))
    graph = ViewGraph.create(
        np.concatenate((chain, ends[0])),
        np.concatenate((chain + 1, ends[1])),
        yaw(angle),
        num_nodes=2 * length,
        kind=[0] * len(chain) + [1] * joins,
    )
    problem = problem_of(graph)
    mode = Mode(problem, *polish(problem, state_of(problem, np.ones(joins, dtype=bool))), "test")
    assert (mode.left_out.log_odds[problem.closure] < 0).all()
    believed = flipped(mode)
    assert not believed.is_false.any()
    assert believed.cost < mode.cost - 5
