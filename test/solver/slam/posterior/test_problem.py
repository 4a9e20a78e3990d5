"""What a problem says of the path, and what it leaves out when switched off."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import fields, replace

import numpy as np
import pytest

from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.labels.false_closures import (
    Discrepancies,
    FalseDensity,
    false_density,
    repeat_rates,
)
from rotavg_ros.solver.slam.posterior.labels.prior import label_log_odds
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.noise import tuned
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import Noise

from .planar import NOISE, planar, problem_of, state_of


def _tuned(problem: Problem) -> set[str]:
    """Names of what other values are looked at of."""
    state, evaluation = polish(problem, state_of(problem, np.zeros(len(problem.closure), dtype=bool)))
    mode = Mode(problem, state, evaluation, "test")
    names = [field.name for field in fields(Noise)]
    return {
        name
        for other in tuned(mode)
        for name in names
        if getattr(other.state.noise, name) != getattr(state.noise, name)
    }


@pytest.mark.parametrize(
    ("name", "is_off"),
    [
        ("tails", lambda problem: not {"step_tails", "closure_tails"} & _tuned(problem)),
        ("near-misses", lambda problem: problem.priors.near_miss_share < 1e-9),
        ("common-errors", lambda problem: problem.system(NOISE).num_runs == 0),
        ("turns", lambda problem: not problem.turns_vary),
        ("slips", lambda problem: bool(np.isposinf(problem.log_odds[problem.graph.is_odometry]).all())),
        ("own-repeats", lambda problem: not np.isfinite(repeat_rates(problem, _repeated(problem))).all()),
        ("repeats", lambda problem: not _repeated(problem).repeats.density.any()),
        ("label-runs", lambda problem: _stickiness(problem) == pytest.approx(0.0, abs=1e-9)),
        ("label-bursts", lambda problem: _bursts(problem) == pytest.approx(0.0, abs=1e-9)),
    ],
)
def test_a_term_is_there_until_it_is_switched_off(name: str, is_off: Callable[[Problem], bool]) -> None:
    graph, _ = planar(0, 8, 0.0)
    assert not is_off(problem_of(graph, SlamPriors()))
    assert is_off(problem_of(graph, SlamPriors(), without={name}))


def _repeated(problem: Problem) -> FalseDensity:
    """The density of a closure that repeats the turn of the one before it."""
    first, second = problem.detection[:2]
    is_false = np.arange(len(problem.closure)) == first
    count = len(problem.closure)
    return false_density(
        problem, is_false, Discrepancies(np.zeros((count, 3)), np.zeros(count), 1e-4), np.array([second])
    )


def _stickiness(problem: Problem) -> float:
    """How far the odds of good closures differ, of which one follows a false one."""
    is_false = np.arange(len(problem.closure)) == problem.follows.max()
    return float(np.ptp(label_log_odds(problem, is_false)[~is_false]))


def _bursts(problem: Problem) -> float:
    """By how much odds change with the label of the closure that was detected last, where no run is followed."""
    alone = replace(problem, follows=np.full(len(problem.closure), -1))
    is_false = np.arange(len(problem.closure)) == problem.detection[0]
    odds = label_log_odds(alone, is_false)
    return float(odds[problem.detection[3]] - odds[problem.detection[1]])


def test_turn_steps_are_as_many_as_steps_and_lie_where_odometry_turns() -> None:
    graph, _ = planar(0, 8, 0.0)
    problem = problem_of(graph, SlamPriors())
    segments = slice(problem.graph.num_segments)
    assert problem.turn_steps[segments].sum() == pytest.approx(problem.graph.own_steps[segments].sum())
    # Turns grow along this path, node n has turned by n² in all.
    nodes = problem.graph.nodes
    passed = nodes[problem.graph.target[segments]] ** 2.0 - nodes[problem.graph.source[segments]] ** 2.0
    ratio = problem.turn_steps[segments] / passed
    np.testing.assert_allclose(ratio, ratio[0])
    assert problem.drawn(NOISE) is problem.graph
    half = problem.drawn(replace(NOISE, turn_share=0.5))
    inside = (problem.graph.fraction > 0) & (problem.graph.fraction < 1)
    assert (half.fraction[inside] < problem.graph.fraction[inside]).all()
    np.testing.assert_array_equal(half.fraction[~inside], problem.graph.fraction[~inside])
