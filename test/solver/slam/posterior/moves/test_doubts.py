"""False closures that agree by chance support each other; a slip that they seemed to tell of is taken back."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from rotavg_ros import solve
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.diagnosis import from_truth
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.doubts import propose_doubts
from rotavg_ros.solver.slam.posterior.solve import Drawn
from test.solver.slam.posterior.lattice import Town, town
from test.solver.slam.posterior.planar import yaw


def orientations(drawn: Town) -> torch.Tensor:
    """``(N, 4)`` body_from_world."""
    return torch.from_numpy(yaw(-drawn.heading))


def where_single_flips_end(drawn: Town) -> Mode:
    """The labelling in which all closures are believed that are off by less than 10°, with single labels flipped."""
    is_wrong = torch.from_numpy(drawn.off_deg > 10)
    mode = from_truth(Drawn.of(drawn.graph, None, ()), orientations(drawn), is_wrong).modes[0]
    return Search(mode.problem).flipped(mode)


def test_what_keeps_each_other_is_rejected_together() -> None:
    gained = []
    for seed in range(12):
        mode = where_single_flips_end(town(seed, keyframes=300, tail=60, closures=150, false=200))
        search = Search(mode.problem)
        costs = [search.flipped(search.polished(each.make(), each.name)).cost for each in propose_doubts(mode)]
        gained.append(mode.cost - min(costs, default=mode.cost))
    assert np.median(gained) > 1 and max(gained) > 5


def test_more_closures_are_doubted_at_each_level() -> None:
    mode = where_single_flips_end(town(0, keyframes=300, tail=60, closures=150, false=200))
    closure, believed = mode.problem.closure, mode.state.is_good
    doubted = [believed & ~proposal.make().is_good for proposal in propose_doubts(mode)]
    assert len(doubted) >= 2
    for fewer, more in pairwise(doubted):
        assert (fewer <= more).all() and more.sum() > fewer.sum() >= 2
    largest = mode.left_out.log_odds[doubted[-1]].max()
    kept = np.setdiff1d(closure[believed[closure]], np.flatnonzero(doubted[-1]))
    assert mode.left_out.log_odds[kept].min() > largest


def test_closures_that_all_else_supports_are_not_doubted() -> None:
    assert not list(propose_doubts(where_single_flips_end(town(0, keyframes=300, tail=60, closures=150, false=0))))


def test_weak_closures_that_the_rest_supports_without_each_other_are_not_doubted() -> None:
    """Rejected together, each would come back at once."""
    mode = where_single_flips_end(town(1, keyframes=300, tail=60, closures=150, false=30))
    believed = mode.problem.closure[~mode.is_false]
    assert (mode.left_out.log_odds[believed] < 5).sum() > 5
    assert not list(propose_doubts(mode))


def test_closures_that_a_user_accepted_are_not_doubted() -> None:
    drawn = town(0, keyframes=300, tail=60, closures=150, false=200)
    label = torch.from_numpy(np.where(drawn.graph.is_odometry.numpy(), 0, np.where(drawn.is_false, 2, 1)))
    labelled = drawn._replace(graph=replace(drawn.graph, label=label))
    assert not list(propose_doubts(where_single_flips_end(labelled)))


@pytest.mark.large
@pytest.mark.parametrize(("without", "is_right"), [("", True), ("~doubts,mending", False)])
def test_a_turn_that_only_false_closures_tell_of_is_taken_back(without: str, is_right: bool) -> None:
    """Two thousand keyframes; a thousand false closures make a step of 67° likely that 67 good ones contradict."""
    drawn = town(31, keyframes=2000, tail=400, closures=1000, false=1000, blocks=10)
    solution = solve(drawn.graph, method=f"neurora{without}")
    errors = orientation_errors(solution.body_from_world, orientations(drawn), drawn.graph.components())
    assert (float(np.degrees(errors.numpy()).mean()) < 5) == is_right
