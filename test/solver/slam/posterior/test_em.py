"""Steps and polishing: undecided closures, where the noise comes to rest, F on the way."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.work import metered
from rotavg_ros.solver.slam.posterior.em import polish, step
from rotavg_ros.solver.slam.posterior.objective import evaluate
from rotavg_ros.view_graph import ViewGraph

from .planar import NOISE, planar, problem_of, state_of, yaw


@pytest.mark.parametrize("chance", [0.0, 0.1, 0.4, 0.9, 1.0])
def test_an_undecided_closure_turns_by_its_chance_what_it_would_turn_as_a_good_one(chance: float) -> None:
    """One closure on a long chain: with a weight that is its chance alone one in ten would turn nearly as much."""
    count = 40
    source, target = np.append(np.arange(count), 0), np.arange(1, count + 2)
    target[-1] = count
    angle = np.append(np.zeros(count), 0.3)
    graph = ViewGraph.create(source, target, yaw(angle), num_nodes=count + 1, kind=[0] * count + [1])
    problem = problem_of(graph)
    state = state_of(problem, np.array([False]))

    def turned(trust: float) -> float:
        trusted = state.trusted.copy()
        trusted[problem.closure] = trust
        # What others say is known after the first step.
        once = step(problem, replace(state, trusted=trusted))[0]
        return float(quaternion_rows.log(step(problem, once)[0].correction)[2, -1])

    assert abs(turned(1.0)) > 0.2
    # 48 samples tell the variance of what the chain predicts to about a fifth.
    assert turned(chance) == pytest.approx(chance * turned(1.0), rel=0.25, abs=1e-9)


def test_f_of_corrections_that_still_move_is_no_gain() -> None:
    graph, _ = planar(0, 8, 0.3)
    problem = problem_of(graph)
    state = state_of(problem, np.zeros(8, dtype=bool))
    at_rest, moving = evaluate(problem, polish(problem, state)[0]), evaluate(problem, state, is_moving=True)
    assert moving.total > at_rest.total + 1e6
    assert not polish(problem, state, 1)[1].is_moving  # it goes on until nothing does
    given_up = replace(problem, limits=replace(problem.limits, polish_solves=1))
    assert polish(given_up, state)[1].is_moving


@pytest.mark.parametrize("seed", range(4))
def test_noise_is_set_to_where_its_sequence_leads(seed: int) -> None:
    """From variances far from what residuals tell; solve by solve it takes up to twelve."""
    graph, _ = planar(seed, 30, 0.0, length=200)
    problem = problem_of(graph)
    noise = replace(NOISE, step_variance=25 * NOISE.step_variance, closure_variance=NOISE.closure_variance / 9)
    begun = replace(state_of(problem, np.zeros(30, dtype=bool)), noise=noise)
    with metered() as meter:
        state, evaluation = polish(problem, begun)
    with metered() as one:
        problem.system(noise).factorise(evaluation.weight)
    # The last one tells F.
    assert meter.spent <= 8.5 * one.spent
    assert evaluation.total == pytest.approx(polish(problem, state)[1].total, abs=0.1)
