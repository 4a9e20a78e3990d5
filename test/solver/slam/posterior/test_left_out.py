"""F against its own leave-one-out odds."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.left_out import leave_one_out

from .planar import planar, problem_of, state_of


@pytest.mark.parametrize("seed", range(6))
def test_a_flip_changes_f_by_the_leave_one_out_log_odds(seed: int) -> None:
    graph, _ = planar(seed, 10, 0.0)
    problem = problem_of(graph)
    good = np.zeros(len(problem.closure), dtype=bool)
    state, before = polish(problem, state_of(problem, good), hold_noise=True)
    exact = np.diag(before.factorised.covariance(problem.closure))
    before.factorised.resistance[problem.closure] = exact
    log_odds = leave_one_out(problem, state, before.factorised).log_odds[problem.closure]
    for number in range(len(problem.closure)):
        flipped = good.copy()
        flipped[number] = True
        _, after = polish(problem, state_of(problem, flipped), hold_noise=True)
        assert after.total - before.total == pytest.approx(log_odds[number], abs=0.02)


@pytest.mark.parametrize("seed", range(3))
def test_a_segment_that_slips_changes_f_by_its_log_odds_before_and_after(seed: int) -> None:
    problem = problem_of(planar(seed, 10, 0.0)[0])
    sound = state_of(problem, np.zeros(len(problem.closure), dtype=bool))
    state, before = polish(problem, sound, hold_noise=True)
    log_odds = leave_one_out(problem, state, before.factorised).log_odds
    for segment in np.flatnonzero(problem.graph.is_odometry)[2:10:3]:
        trusted = sound.trusted.copy()
        trusted[segment] = 0.0
        slipped, after = polish(problem, replace(sound, trusted=trusted), hold_noise=True)
        turned_back = leave_one_out(problem, slipped, after.factorised).log_odds
        assert after.total - before.total == pytest.approx(log_odds[segment], abs=0.02)
        assert after.total - before.total == pytest.approx(turned_back[segment], abs=0.02)
