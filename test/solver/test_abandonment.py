"""A solve that is given up ends soon, leaves nothing behind, and says nothing to solves beside it."""

from __future__ import annotations

import threading
from collections.abc import Callable

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, solve
from rotavg_ros.solver import METHODS, PROFILES, Abandoned, abandonable
from rotavg_ros.view_graph import EdgeKind


def chain_with_closures(nodes: int, closures: int, kind: int = EdgeKind.ODOMETRY) -> ViewGraph:
    """A random walk, and as many closures at random of which a few are good."""
    draw = np.random.default_rng(0)
    truth = Rotation.from_rotvec(np.cumsum(draw.normal(0, 0.05, (nodes, 3)), axis=0))
    source = np.concatenate((np.arange(nodes - 1), draw.integers(0, nodes - 1, closures)))
    target = np.concatenate((np.arange(1, nodes), (source[nodes - 1 :] + draw.integers(1, nodes, closures)) % nodes))
    sigma = np.repeat((0.01, 0.3), (nodes - 1, closures))[:, None]
    noise = Rotation.from_rotvec(draw.normal(0, sigma, (len(source), 3)))
    measured = noise * truth[target].inv() * truth[source]
    kinds = np.repeat((kind, EdgeKind.LOOP_CLOSURE), (nodes - 1, closures))
    return ViewGraph.create(source, target, measured.as_quat(), kind=kinds)


class After:
    """Says yes from the n-th question on."""

    def __init__(self, number: int) -> None:
        self.number, self.asked = number, 0

    def __call__(self) -> bool:
        self.asked += 1
        return self.asked > self.number


@pytest.mark.parametrize("profile", ["slam", "sfm"])
def test_a_solve_asks_all_the_way_and_ends_at_once_when_told(profile: str) -> None:
    graph = chain_with_closures(150, 100, EdgeKind.ODOMETRY if profile == "slam" else EdgeKind.LOOP_CLOSURE)
    never = After(10**9)
    with abandonable(never):
        whole = solve(graph, profile=profile)
    assert never.asked > 20
    for number in (0, 1, never.asked // 2, never.asked - 1):
        told = After(number)
        with pytest.raises(Abandoned), abandonable(told):
            solve(graph, profile=profile)
        assert told.asked <= number + 1 + torch.get_num_threads()  # each worker asks for itself
    again = solve(graph, profile=profile)
    assert torch.equal(again.body_from_world, whole.body_from_world)
    assert torch.equal(again.outlier_score, whole.outlier_score)


@pytest.mark.parametrize("threads", [1, 2])
def test_threads_are_as_before(threads: int) -> None:
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        with pytest.raises(Abandoned), abandonable(After(3)):
            solve(chain_with_closures(300, 600, EdgeKind.LOOP_CLOSURE))
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)


def test_what_an_earlier_answer_remembers_stays_good() -> None:
    graph = chain_with_closures(300, 100)
    first = graph.select_edges(torch.arange(graph.num_edges - 1))
    earlier = solve(first)
    expected = solve(graph, warm_start=earlier.body_from_world, memory=earlier.memory)
    for number in range(0, 60, 7):
        told = After(number)
        with abandonable(told):
            try:
                solve(graph, warm_start=earlier.body_from_world, memory=earlier.memory)
            except Abandoned:
                continue
            break
    else:
        pytest.fail("an update asks more often than it should")
    assert number > 0
    found = solve(graph, warm_start=earlier.body_from_world, memory=earlier.memory)
    assert torch.equal(found.body_from_world, expected.body_from_world)
    assert torch.equal(found.outlier_score, expected.outlier_score)


def test_solves_side_by_side_are_given_up_one_by_one() -> None:
    graph, halfway, go_on = chain_with_closures(300, 600), threading.Event(), threading.Event()

    def wait_and_stop() -> bool:
        if threading.current_thread() is not thread:
            return False  # workers are shared, and must not be held up
        halfway.set()
        assert go_on.wait(60)
        return True

    ends: list[type] = []

    def run(is_abandoned: Callable[[], bool]) -> None:
        try:
            with abandonable(is_abandoned):
                ends.append(type(solve(graph)))
        except Abandoned:
            ends.append(Abandoned)

    thread = threading.Thread(target=run, args=(wait_and_stop,))
    thread.start()
    assert halfway.wait(60)
    run(lambda: False)
    go_on.set()
    thread.join(60)
    assert [end.__name__ for end in ends] == ["Solution", "Abandoned"]


@pytest.mark.parametrize("nodes", [0, 3])
@pytest.mark.parametrize("profile", PROFILES)
@pytest.mark.parametrize("method", METHODS)
def test_a_graph_without_edges_is_nothing_to_solve(method: str, profile: str, nodes: int) -> None:
    graph = ViewGraph.create([], [], torch.zeros(0, 4), num_nodes=nodes)
    solution = solve(graph, method=method, profile=profile)
    identity = torch.tensor([0.0, 0.0, 0.0, 1.0]).double().expand(nodes, 4)
    assert torch.equal(solution.body_from_world, identity)
    assert solution.component.tolist() == list(range(nodes)) and len(solution.outlier_score) == 0
