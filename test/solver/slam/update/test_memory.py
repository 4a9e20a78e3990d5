"""A graph that grows by a handful of edges: updates that go on from the verdicts so far, against whole solves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import ViewGraph, rotations, solve
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.online.answer.gauge import extend_along_edges
from rotavg_ros.solver.slam.update.memory import SlamMemory, UpdateLimits
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import EdgeKind, EdgeLabel

NUM_KEYFRAMES = 600


@pytest.fixture(scope="module")
def city() -> ViewGraph:
    """Eight laps, a closure a keyframe, one in ten of them false; edges in the order in which a robot reports them."""
    config = SlamSimulationConfig(
        world=World.CITY, num_keyframes=NUM_KEYFRAMES, laps=8, closures_per_keyframe=1.0, false_share=0.1
    )
    return simulate_slam_graph(config, np.random.default_rng(1000)).graph


def until(graph: ViewGraph, num_keyframes: int) -> ViewGraph:
    """What of it a robot has reported after so many keyframes."""
    reported = torch.maximum(graph.source, graph.target) < num_keyframes
    return replace(graph.select_edges(reported.nonzero().squeeze(1)), num_nodes=num_keyframes)


def grown(solution: Solution, graph: ViewGraph) -> Solution:
    """The next tick's."""
    start = extend_along_edges(solution.body_from_world, graph)
    return solve(graph, warm_start=start, memory=solution.memory)


def limited(solution: Solution, limits: UpdateLimits) -> Solution:
    """The solution, whose memory goes on within other limits."""
    assert isinstance(solution.memory, SlamMemory)
    return replace(solution, memory=replace(solution.memory, limits=limits))


@pytest.mark.parametrize(
    ("is_large", "max_entries"), [(False, 24), (True, 24), (True, 0)], ids=["renewed", "followed", "factorised anew"]
)
def test_updates_end_where_a_whole_solve_does(city: ViewGraph, is_large: bool, max_entries: int) -> None:
    limits = UpdateLimits(large_graph=0, entries=max_entries) if is_large else UpdateLimits()
    solution = limited(solve(until(city, 500)), limits)
    updates = followed = 0
    for num_keyframes in range(508, NUM_KEYFRAMES + 1, 4):
        solution = grown(solution, until(city, num_keyframes))
        updates += "update" in solution.stage_seconds and "refine" not in solution.stage_seconds
        memory = limited(solution, limits).memory
        assert isinstance(memory, SlamMemory)
        solution = replace(solution, memory=memory)
        followed += memory.factor is not None and len(memory.factor.closures) > 0
        assert (memory.prediction_variance[memory.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE] > 0).all()
    assert followed >= 10 if is_large and max_entries else followed == 0
    assert updates >= 15  # of 24; the others have seen the whole graph
    whole = solve(city)
    difference = torch.rad2deg(rotations.angle_between(solution.body_from_world, whole.body_from_world))
    assert float(difference.mean()) < 0.1
    assert int(((solution.outlier_score > 0.5) != (whole.outlier_score > 0.5)).sum()) <= 3
    torch.testing.assert_close(solution.uncertainty.mean(), whole.uncertainty.mean(), rtol=0.1, atol=0.0)


def test_odometry_alone_says_nothing_of_what_was_there(city: ViewGraph) -> None:
    before = solve(until(city, 500))
    graph = until(city, 520)
    is_known = torch.maximum(graph.source, graph.target) < 500
    graph = graph.select_edges(is_known | graph.is_odometry)
    after = grown(before, graph)
    assert "refine" not in after.stage_seconds
    torch.testing.assert_close(after.body_from_world[:500], before.body_from_world, rtol=0, atol=1e-9)
    num_known = int(is_known.sum())
    torch.testing.assert_close(after.outlier_score[:num_known], before.outlier_score)
    torch.testing.assert_close(after.uncertainty[:500], before.uncertainty)
    new = graph.select_edges(torch.arange(num_known, graph.num_edges))
    predicted = rotations.multiply(new.target_from_source, after.body_from_world[new.source])
    assert float(rotations.angle_between(predicted, after.body_from_world[new.target]).max()) < 1e-6
    variance = after.uncertainty[499:].numpy() ** 2
    np.testing.assert_allclose(np.diff(variance), np.diff(variance)[0])  # a random walk
    assert variance[1] > variance[0]


@pytest.mark.parametrize("is_large", [False, True], ids=["factorised anew", "followed"])
@pytest.mark.parametrize("has_closure", [False, True])
def test_a_second_robot_begins(city: ViewGraph, has_closure: bool, is_large: bool) -> None:
    before = limited(solve(until(city, 500)), UpdateLimits(large_graph=0) if is_large else UpdateLimits())
    first = 504 if has_closure else 500
    chain = until(city, 4)
    chain = chain.select_edges(chain.is_odometry)
    known, both = until(city, 500), until(city, first)
    later = both.select_edges(torch.maximum(both.source, both.target) >= 500)
    parts = known, later, replace(chain, source=chain.source + first, target=chain.target + first)
    names = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")
    columns = {name: torch.cat([getattr(part, name) for part in parts]) for name in names}
    graph = ViewGraph(first + 4, **columns)
    after, whole = grown(before, graph), solve(graph)
    assert "refine" not in after.stage_seconds
    torch.testing.assert_close(after.uncertainty[first:], whole.uncertainty[first:], rtol=0.3, atol=1e-9)
    angle = rotations.angle_between(after.body_from_world, whole.body_from_world)
    assert np.degrees(float(angle.mean())) < 0.1


@pytest.mark.parametrize("was_good", [True, False])
def test_a_wrong_verdict_is_put_right_in_an_update(city: ViewGraph, was_good: bool) -> None:
    graph = until(city, 500)
    before = solve(graph)
    assert isinstance(before.memory, SlamMemory)
    is_closure, score = graph.kind == EdgeKind.LOOP_CLOSURE, before.outlier_score
    edge = int(torch.where(is_closure, score if was_good else 1 - score, torch.inf).argmin())
    mistaken = before.memory.inlier_probability.copy()
    mistaken[edge] = 0.001 if was_good else 0.999
    memory = replace(before.memory, inlier_probability=mistaken)
    after = grown(replace(before, memory=memory), until(city, 502))
    assert "refine" not in after.stage_seconds
    assert bool(after.outlier_score[edge] < 0.5) is was_good


def test_much_that_is_new_is_judged_as_a_whole(city: ViewGraph) -> None:
    solution = limited(solve(until(city, 500)), UpdateLimits(columns=3))
    for num_keyframes, is_whole in ((502, False), (520, True)):
        solution = grown(solution, until(city, num_keyframes))
        assert ("refine" in solution.stage_seconds) is is_whole


@pytest.mark.parametrize("change", ["label", "rotation", "fewer edges"])
def test_what_has_not_only_grown_is_solved_as_a_whole(city: ViewGraph, change: str) -> None:
    before = solve(until(city, 500))
    graph = until(city, 504)
    if change == "label":
        graph.label[-1] = EdgeLabel.REJECTED
    elif change == "rotation":
        graph.target_from_source[3] = rotations.identity(1)[0]
    else:
        graph = until(city, 499)
    start = extend_along_edges(before.body_from_world[: graph.num_nodes], graph)
    with_memory, without = solve(graph, warm_start=start, memory=before.memory), solve(graph, warm_start=start)
    assert "refine" in with_memory.stage_seconds
    torch.testing.assert_close(with_memory.body_from_world, without.body_from_world, rtol=0, atol=0)
    torch.testing.assert_close(with_memory.outlier_score, without.outlier_score, rtol=0, atol=0)


def test_the_whole_solve_comes_round(city: ViewGraph) -> None:
    solution, counts = limited(solve(until(city, 560)), UpdateLimits(updates=2)), []
    for num_keyframes in range(561, 564):
        solution = grown(solution, until(city, num_keyframes))
        assert isinstance(solution.memory, SlamMemory)
        counts.append(solution.memory.updates)
    assert counts == [1, 2, 0]
