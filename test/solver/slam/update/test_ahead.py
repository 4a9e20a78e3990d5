"""Whole searches that run beside updates, some steps at each."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.solver import Solution, solve
from rotavg_ros.solver.algebra.running import Abandoned, abandonable, done
from rotavg_ros.solver.estimate import Run, Stopwatch
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.solve import whole
from rotavg_ros.solver.slam.update.ahead import WholeSolve
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import ViewGraph

from .test_memory import drawn, error_deg, grown, until

# Of the whole search, small: a tick does a step or two.
WORK = 2.0


def steps_of(graph: ViewGraph) -> WholeSolve:
    return WholeSolve(whole(graph, SlamStages(), Run(Networks("cpu"), Stopwatch())))


@torch.no_grad()
def test_in_steps_it_ends_where_it_does_at_once() -> None:
    case = drawn("building: 30 % random", 1)
    at_once = done(whole(case.graph, SlamStages(), Run(Networks("cpu"), Stopwatch())))
    ahead, calls = steps_of(case.graph), 1
    while (found := ahead.go_on(0.0)) is None:
        calls += 1
    assert calls > 5
    assert torch.equal(found.body_from_world, at_once.body_from_world)
    assert torch.equal(found.outlier_score, at_once.outlier_score)


def test_ticks_spend_their_budget_and_a_step_more_and_lead_to_the_same_answer() -> None:
    case = drawn("building: 30 % random", 1)
    graph = until(case.graph, count := 300)
    begun = solution = solve(graph, profile="slam")
    searched, spent, updates = 0, [], []
    for number in range(count + 2, case.graph.num_nodes + 1, 2):
        graph = until(case.graph, number)
        start = grown(graph, solution)
        solution = solve(graph, profile="slam", warm_start=start, memory=solution.memory, work=WORK)
        assert isinstance(solution.memory, SlamMemory)
        searches = "search" in solution.stage_seconds
        (spent if searches else updates).append(solution.work)
        searched += searches and solution.memory.ahead is None
        assert "refine" not in solution.stage_seconds  # nobody waits for the whole of it
    assert searched >= 2
    assert len(spent) > 3 * searched
    # Of a whole solve at once, a tick with a step of it is a part.
    assert sorted(spent)[len(spent) // 2] < 0.3 * solve(graph, profile="slam").work
    assert begun.work > 0
    cold = solve(graph, profile="slam")
    errors = [error_deg(graph, one.body_from_world, case.body_from_world) for one in (solution, cold)]
    assert errors[0] < 1.2 * errors[1] + 0.1


def test_closures_that_are_explained_ask_for_no_search() -> None:
    case = drawn("building: 30 % random", 1)
    graph = case.graph
    closures = torch.nonzero(~graph.is_odometry)[:, 0]
    false = torch.from_numpy(case.is_false)[closures]
    good, wrong = closures[~false], closures[false]
    odometry = torch.nonzero(graph.is_odometry)[:, 0]
    known = graph.select_edges(torch.cat((odometry, good[:-5])))
    before = solve(known, profile="slam")
    searches = []
    for more in (good[-5:], torch.cat((good[-5:], wrong[: len(good) // 10]))):
        after = graph.select_edges(torch.cat((odometry, good[:-5], more)))
        start = before.body_from_world
        found = solve(after, profile="slam", warm_start=start, memory=before.memory, work=WORK)
        searches.append("search" in found.stage_seconds)
    assert searches == [False, True]


def searching(case: DrawnGraph) -> tuple[ViewGraph, Solution, WholeSolve]:
    """A graph that has grown until a whole search is under way, its answer, and that search."""
    number, graph = 300, until(case.graph, 300)
    solution = solve(graph, profile="slam")
    while not isinstance(solution.memory, SlamMemory) or solution.memory.ahead is None:
        number += 2
        graph = until(case.graph, number)
        start = grown(graph, solution)
        solution = solve(graph, profile="slam", warm_start=start, memory=solution.memory, work=0.0)
    return graph, solution, solution.memory.ahead


def test_a_search_that_was_abandoned_begins_anew() -> None:
    """A tick that is paused in the middle of a step leaves what was remembered as it was, and no dead search in it."""
    case = drawn("building: 30 % random", 1)
    graph, solution, ahead = searching(case)
    asked = 0

    def after_a_while() -> bool:
        nonlocal asked
        asked += 1
        return asked > 20

    graph = until(case.graph, graph.num_nodes + 2)
    start = grown(graph, solution)
    with pytest.raises(Abandoned), abandonable(after_a_while):
        solve(graph, profile="slam", warm_start=start, memory=solution.memory)
    assert ahead.has_failed
    found = solve(graph, profile="slam", warm_start=start, memory=solution.memory)
    assert isinstance(found.memory, SlamMemory) and found.memory.ahead is None
    whole_one = solve(graph, profile="slam")
    errors = [error_deg(graph, one.body_from_world, case.body_from_world) for one in (found, whole_one)]
    assert errors[0] < 1.2 * errors[1] + 0.1


def test_a_keyframe_without_edges_comes_while_a_search_ends() -> None:
    """Another robot begins: its first keyframe hangs on nothing yet."""
    graph, solution, _ = searching(drawn("building: 30 % random", 1))
    more = replace(graph, num_nodes=graph.num_nodes + 1)
    found = solve(more, profile="slam", warm_start=grown(more, solution), memory=solution.memory)
    assert len(found.body_from_world) == len(found.uncertainty) == more.num_nodes
    assert int(found.component[-1]) == 1


def test_without_a_budget_the_search_is_done_at_once() -> None:
    case = drawn("building: 30 % random", 1)
    graph = case.graph
    is_false = torch.from_numpy(case.is_false) & ~graph.is_odometry
    order = torch.argsort(is_false.long(), stable=True)
    most = order[: graph.num_edges - int(is_false.sum()) + 2]
    before = solve(graph.select_edges(most), profile="slam")
    found = solve(graph.select_edges(order), profile="slam", warm_start=before.body_from_world, memory=before.memory)
    assert "search" in found.stage_seconds
    assert isinstance(found.memory, SlamMemory) and found.memory.ahead is None and found.memory.unexplained == 0
