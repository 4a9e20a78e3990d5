"""When labels are worth settling: where one is open."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode, Proposal
from rotavg_ros.solver.slam.posterior.moves.settling import propose_settling
from test.solver.slam.posterior.planar import planar, problem_of, state_of


def mode_of(seed: int, opinion: float = 0.0) -> Mode:
    """A labelling that no single flip betters; the network says of each closure what its label is, or nothing."""
    graph, off = planar(seed, 12, 0.4)
    problem = problem_of(graph)
    mode = flipped(Mode(problem, *polished(problem, np.abs(off) > 0.1), "begun"))
    told = problem.log_odds.copy()
    told[problem.closure] = np.where(mode.is_false, -opinion, opinion)
    other = replace(problem, log_odds=told)
    return Mode(other, *polished(other, mode.is_false), "told")


def polished(problem, is_false: np.ndarray):
    mode = Search(problem).polished(state_of(problem, is_false), "begun")
    return mode.state, mode.evaluation


def flipped(mode: Mode) -> Mode:
    return Search(mode.problem).flipped(mode)


def proposal_of(mode: Mode) -> Proposal:
    (proposal,) = propose_settling(mode)
    return proposal


@pytest.mark.parametrize("seed", range(8))
def test_labels_that_all_others_decide_stay(seed: int) -> None:
    """So it is not tried: labels that were settled are those before."""
    mode = mode_of(seed)
    proposal = proposal_of(mode)
    assert proposal.predicted == pytest.approx(np.abs(mode.left_out.log_odds[mode.problem.closure]).min())
    settled = proposal.make()
    if proposal.predicted > 3:
        np.testing.assert_array_equal(settled.is_good, mode.state.is_good)


def test_some_are_decided_and_some_are_open() -> None:
    """Or the test above tells nothing."""
    predicted = np.array([proposal_of(mode_of(seed)).predicted for seed in range(8)])
    assert (predicted > 3).any() and (predicted < 1).any()


@pytest.mark.parametrize("seed", range(3))
def test_what_cleannet_decides_is_not_asked(seed: int) -> None:
    """Its opinion is part of what each label would cost."""
    assert proposal_of(mode_of(seed, opinion=20.0)).predicted > 10


def test_labels_that_a_user_gave_are_not_open() -> None:
    assert proposal_of(mode_of(0, opinion=np.inf)).predicted == np.inf
