"""A robot's graph that grows while updates and whole searches run beside its answers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph
from rotavg_ros.evaluation.live.feed import Feed
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.solver import Solution, advance, solve
from rotavg_ros.solver.estimate import Run, Stopwatch
from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.running.resumable import Resumable
from rotavg_ros.solver.running.work import Abandoned, abandonable, metered, resting
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import fine_tuned
from rotavg_ros.solver.slam.links import as_odometry
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.options import SlamStages
from rotavg_ros.solver.slam.poses.solve import poses_of_update
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.solver.slam.solve import whole
from rotavg_ros.solver.slam.update.memory import SlamMemory
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

from ..linked_keyframes import linked
from .test_conditioned import drawn as simulated
from .test_memory import drawn, error_deg, grown, until

# Less than an update takes: each tick lays on what is new.
LITTLE = 2.0


def whole_of(graph: ViewGraph) -> Resumable:
    return Resumable(lambda: whole(graph, SlamStages(), Run(Networks("cpu"), Stopwatch())))


def remembered(solution: Solution) -> SlamMemory:
    assert isinstance(solution.memory, SlamMemory)
    return solution.memory


def go_on(graph: ViewGraph, solution: Solution, work: float | None = LITTLE, anew: bool = False) -> Solution:
    start = grown(graph, solution)
    return solve(graph, profile="slam", warm_start=start, memory=solution.memory, work=work, anew=anew)


@torch.no_grad()
def test_little_by_little_it_ends_where_it_does_at_once() -> None:
    case = drawn("building: 30 % random", 1)
    with metered() as meter:
        at_once = whole(case.graph, SlamStages(), Run(Networks("cpu"), Stopwatch()))
    ahead, calls = whole_of(case.graph), 1
    while not ahead.go_on(0.0):
        calls += 1
    assert calls > 100
    assert ahead.spent == pytest.approx(meter.spent)
    assert torch.equal(ahead.result.body_from_world, at_once.body_from_world)
    assert torch.equal(ahead.result.outlier_score, at_once.outlier_score)


@torch.no_grad()
def test_all_that_an_update_does_is_counted_where_it_is_done() -> None:
    """A piece that takes part of a second on a large map and says nothing would be done beside a whole ration."""
    graph, _ = simulated(translations=True, planar=True)
    solution, networks = solve(until(graph, graph.num_nodes - 10), profile="slam"), Networks("cpu")
    memory, pieces = remembered(solution), list[float]()
    clean_net, fine_net = networks.load(SlamCleanNet), networks.load(SlamFineNet)
    with resting(pieces.append):
        Drawn.of(graph, clean_net)
    # Odometry, neighbours, CleanNet, the rest.
    assert len(pieces) == 4 and min(pieces) > 0.0
    assert max(pieces) < 0.6 * sum(pieces)
    found = memory.updated(graph, (clean_net, fine_net), grown(graph, solution))
    assert memory.poses is not None
    pieces.clear()
    with resting(pieces.append):
        assert poses_of_update(graph, found.mode, memory.poses) is not None
    silent = sum(units == 0.0 for units in pieces)
    assert silent < 0.2 * len(pieces)
    pieces.clear()
    with resting(pieces.append):
        fine_tuned(found.mode, fine_net, passes=1)
    assert pieces[0] > 0.0 and pieces[1] > 0.0


@pytest.mark.large
def test_ticks_answer_at_once_and_the_rest_leads_to_the_same_answer() -> None:
    case = drawn("building: 30 % random", 1)
    graph = until(case.graph, count := 300)
    solution = solve(graph, profile="slam")
    searched, answers, laid_on, errors = 0, [], 0, []
    for number in range(count + 2, case.graph.num_nodes + 1, 2):
        graph = until(case.graph, number)
        solution = go_on(graph, solution)
        answers.append(solution.work)
        laid_on += remembered(solution).update is not None
        errors.append(error_deg(graph, solution.body_from_world, case.body_from_world))
        assert len(solution.outlier_score) == graph.num_edges
        was_searching = remembered(solution).ahead is not None
        advance(solution.memory, 10 * LITTLE)
        searched += was_searching and remembered(solution).ahead.has_ended
    assert laid_on > 20
    assert searched >= 2
    cold = solve(graph, profile="slam")
    # Nobody waits for more than a factorisation, of which a whole solve has hundreds.
    assert max(answers) < 0.1 * cold.work
    error = error_deg(graph, cold.body_from_world, case.body_from_world)
    assert errors[-1] < 1.2 * error + 0.1
    assert sum(errors) / len(errors) < 1.5 * error + 0.2


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
        found = go_on(after, before, work=1e6)
        searches.append(remembered(found).ahead is not None)
    assert searches == [False, True]


def searching(case: DrawnGraph) -> tuple[ViewGraph, Solution]:
    """A graph that has grown until a whole search is under way, and its answer."""
    number, graph = 300, until(case.graph, 300)
    solution = solve(graph, profile="slam")
    while remembered(solution).ahead is None:
        number += 2
        graph = until(case.graph, number)
        solution = go_on(graph, solution, work=1e6)
    advance(solution.memory, 1.0)
    return graph, solution


def test_a_search_that_was_abandoned_begins_anew() -> None:
    """A tick that is paused in the middle leaves what was remembered as it was, and no dead search in it."""
    case = drawn("building: 30 % random", 1)
    graph, solution = searching(case)
    asked = 0

    def after_a_while() -> bool:
        nonlocal asked
        asked += 1
        return asked > 20

    with pytest.raises(Abandoned), abandonable(after_a_while):
        advance(solution.memory, 1e9)
    assert remembered(solution).ahead.has_failed
    assert advance(solution.memory, 1e9) == 0  # and does no harm
    graph = until(case.graph, graph.num_nodes + 2)
    found = go_on(graph, solution, work=None)
    assert remembered(found).ahead is None
    whole_one = solve(graph, profile="slam")
    errors = [error_deg(graph, one.body_from_world, case.body_from_world) for one in (found, whole_one)]
    assert errors[0] < 1.2 * errors[1] + 0.1


def test_a_keyframe_without_edges_comes_while_a_search_ends() -> None:
    """Another robot begins: its first keyframe hangs on nothing yet."""
    graph, solution = searching(drawn("building: 30 % random", 1))
    more = replace(graph, num_nodes=graph.num_nodes + 1)
    found = go_on(more, solution, work=None)
    assert len(found.body_from_world) == len(found.uncertainty) == more.num_nodes
    assert int(found.component[-1]) == 1


def test_without_a_budget_the_search_is_done_at_once() -> None:
    case = drawn("building: 30 % random", 1)
    graph = case.graph
    is_false = torch.from_numpy(case.is_false) & ~graph.is_odometry
    order = torch.argsort(is_false.long(), stable=True)
    most = order[: graph.num_edges - int(is_false.sum()) + 2]
    before = solve(graph.select_edges(most), profile="slam")
    found = go_on(graph.select_edges(order), before, work=None)
    assert "search" in found.stage_seconds
    assert remembered(found).ahead is None and remembered(found).unexplained == 0


def test_in_silence_the_answer_becomes_that_of_a_solve_from_scratch() -> None:
    case = drawn("building: 30 % random", 1)
    graph = until(case.graph, 500)
    solution, ticks = go_on(graph, solve(until(case.graph, 480), profile="slam")), 0
    while not (solution := go_on(graph, solution, anew=True)).is_anew:
        advance(solution.memory, 30.0)
        ticks += 1
    assert ticks > 2
    cold = solve(graph, profile="slam")
    assert torch.equal(solution.body_from_world, cold.body_from_world)
    assert torch.equal(solution.outlier_score, cold.outlier_score)


def test_a_solve_from_scratch_goes_on_as_a_search_when_silence_is_broken() -> None:
    case = drawn("building: 30 % random", 1)
    graph = until(case.graph, 500)
    solution = go_on(graph, solve(until(case.graph, 480), profile="slam"), anew=True)
    ahead = remembered(solution).ahead
    assert ahead is not None and not solution.is_anew
    solution = go_on(until(case.graph, 502), solution)
    assert remembered(solution).ahead is ahead
    advance(solution.memory, 1e6)
    solution = go_on(until(case.graph, 504), solution, work=1e6)
    assert not solution.is_anew
    assert remembered(solution).ahead is not ahead


def test_what_cannot_be_gone_on_from_is_solved_from_scratch_in_silence_too() -> None:
    """A memory of another graph, as after a compaction, and a start that is no good."""
    case = drawn("building: 30 % random", 1)
    before = solve(until(case.graph, 300), profile="slam")
    graph = until(case.graph, 200)
    start = torch.nn.functional.normalize(torch.randn(200, 4, generator=torch.Generator().manual_seed(0)).double())
    found = solve(graph, profile="slam", warm_start=start, memory=before.memory, work=LITTLE, anew=True)
    cold = solve(graph, profile="slam")
    assert found.is_anew
    assert torch.equal(found.body_from_world, cold.body_from_world)


@pytest.mark.large
def test_between_ticks_what_has_no_translation_moves_no_position() -> None:
    """New closures without one count with their rotation alone; new odometry without one ends the positions."""
    full, _ = simulated(translations=True, planar=True)
    before = until(full, full.num_nodes - 10)
    solution, graph = solve(before, profile="slam"), until(full, full.num_nodes)
    assert solution.position is not None and graph.translation is not None
    is_new = torch.arange(graph.num_edges) >= before.num_edges
    for edges in (is_new & ~graph.is_odometry, is_new & graph.is_odometry):
        less = replace(graph, translation=torch.where(edges[:, None], torch.nan, graph.translation))
        after = go_on(less, solution, work=0.0)
        if bool((edges & graph.is_odometry).any()):
            assert after.position is None
        else:
            assert after.position is not None and bool(torch.isfinite(after.position).all())
            assert after.edge_precision is not None and remembered(after).update is not None
            assert bool((after.edge_precision[edges, 0] > 0).any())
            assert bool((after.edge_precision[edges, 1] == 0).all())


@pytest.mark.parametrize("with_places", [False, True])
def test_odometry_beside_the_chain_waits_for_an_update_as_closures_do(with_places: bool) -> None:
    """Where a front end sends odometry over two steps as well, each tick had been an update, however long that took."""
    case = drawn("building: 30 % random", 1)
    graph = linked(case, 0.1, by_truth=True, spans=(2,))
    beside = np.arange(case.graph.num_edges, graph.num_edges)
    graph = as_odometry(graph, beside, np.full(len(beside), 2.0))
    assert graph.translation is not None
    unknown = graph.steps > 1 if with_places else torch.ones(graph.num_edges, dtype=torch.bool)
    graph = replace(graph, translation=torch.where(unknown[:, None], torch.nan, graph.translation))
    solution = solve(until(graph, 200), profile="slam")
    known = remembered(solution).graph
    for count in (202, 204):
        solution = go_on(until(graph, count), solution, work=0.0)
        assert solution.work < 0.1 * remembered(solution).update_work
        assert remembered(solution).graph is known and remembered(solution).update is not None
        assert (solution.edge_precision is not None) is with_places
        assert solution.edge_precision is None or bool(torch.isfinite(solution.edge_precision).all())
    advance(solution.memory, 1e6)
    solution = go_on(until(graph, 206), solution, work=1e6)
    assert remembered(solution).graph.num_nodes == 206
    whole = solve(until(graph, 206), profile="slam")
    angle = rotations.angle_between(solution.body_from_world, whole.body_from_world)
    assert np.degrees(float(angle.mean())) < 0.3


def test_odometry_that_joins_chains_does_not_wait() -> None:
    """A robot is at another one's keyframe after all: until it is solved, what that means is not known."""
    case = drawn("building: 15 closures", 1)
    chain = case.graph.select_edges(case.graph.is_odometry)
    apart = chain.select_edges(torch.arange(chain.num_edges) != 100)
    solution = solve(apart, profile="slam")
    order = [*(edge for edge in range(chain.num_edges) if edge != 100), 100]
    found = go_on(chain.select_edges(torch.tensor(order)), solution, work=0.0)
    assert remembered(found).graph.num_edges == chain.num_edges and int(found.component.max()) == 0


@pytest.mark.large
@pytest.mark.parametrize("with_places", [False, True])
def test_a_graph_that_has_lost_keyframes_is_gone_on_from_by_its_labels(with_places: bool) -> None:
    """A full map drops keyframes every now and then: no tick waits for a whole search, and nothing is forgotten."""
    case = drawn("building: 30 % random", 1)
    translation = torch.from_numpy(case.edge_translation) if with_places else None
    graph = replace(case.graph, translation=translation)
    options = EstimatorOptions(keyframe_source="edges", gauge="identity", max_keyframes=260)
    online = OnlineEstimator(options)
    feed, dropped, thinned = Feed(graph, online), 0, 0
    for end in range(200, graph.num_nodes + 1, 5):
        feed.until(end)
        answer = online.tick(work=LITTLE)
        online.go_on()
        assert answer is not None
        if online.counts().marginalized > dropped:
            dropped, thinned = online.counts().marginalized, thinned + 1
            assert set(answer.stage_seconds) == {"update"}
            at = torch.from_numpy(answer.keyframe_id.astype(np.int64))
            cold = solve(answer_graph(online), profile="slam")
            assert (torch.from_numpy(answer.outlier) == (cold.outlier_score > 0.5)).float().mean() > 0.99
            found = rotations.inverse(torch.from_numpy(answer.world_from_body.copy()))
            truth = torch.from_numpy(case.body_from_world)[at]
            assert error_of(found, truth) < error_of(cold.body_from_world, truth) + 0.2
        if thinned == 3:
            return
    pytest.fail("too few keyframes were dropped")


def test_as_many_keyframes_may_have_come_as_were_dropped() -> None:
    """Between two ticks, where few can be spared at a time: the next one had been a whole search."""
    case = drawn("building: 30 % random", 1)
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges", gauge="identity", max_keyframes=200))
    feed = Feed(case.graph, online)
    feed.until(190)
    before = online.tick()
    feed.until(235)
    assert before is not None and online.counts().marginalized > 0
    assert online.counts().keyframes >= len(before.keyframe_id)
    answer = online.tick(work=LITTLE)
    assert answer is not None and set(answer.stage_seconds) == {"update"}
    cold = solve(answer_graph(online), profile="slam")
    assert (torch.from_numpy(answer.outlier) == (cold.outlier_score > 0.5)).float().mean() > 0.98
    found = rotations.inverse(torch.from_numpy(answer.world_from_body.copy()))
    truth = torch.from_numpy(case.body_from_world)[torch.from_numpy(answer.keyframe_id.astype(np.int64))]
    assert error_of(found, truth) < error_of(cold.body_from_world, truth) + 0.2


def answer_graph(online: OnlineEstimator) -> ViewGraph:
    """What the last answer is of."""
    return online.snapshot().graph


def error_of(body_from_world: torch.Tensor, truth: torch.Tensor) -> float:
    return float(torch.rad2deg(orientation_errors(body_from_world, truth)).mean())


def test_another_graph_or_other_labels_are_no_thinned_one() -> None:
    case = drawn("building: 30 % random", 1)
    memory = remembered(solve(until(case.graph, 300), profile="slam"))
    graph = until(case.graph, 290)
    thinned = replace(memory, warnings=("slipped (between nodes 3 and 299): look there",)).thinned_to(graph)
    assert thinned is not None
    assert thinned.warnings == ("slipped (before nodes were dropped): look there",)  # rows are others' now
    assert memory.thinned_to(memory.graph) is None
    closures = (~graph.is_odometry).nonzero()[:, 0]
    label = graph.label.clone()
    label[closures[3]] = EdgeLabel.REJECTED
    assert memory.thinned_to(replace(graph, label=label)) is None
    other = graph.target_from_source.clone()
    other[closures] = torch.nn.functional.normalize(torch.randn(len(closures), 4).to(other))
    assert memory.thinned_to(replace(graph, target_from_source=other)) is None
    slipped = memory.trusted.copy()
    slipped[int(graph.is_odometry.nonzero()[5, 0])] = 0.0
    assert replace(memory, trusted=slipped).thinned_to(graph) is None
