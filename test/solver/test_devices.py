"""GPUs: what is done without one, with one that fails, and, where there is one, that its answer is the CPU's."""

from __future__ import annotations

import logging

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros import ViewGraph, rotations, solve, solve_batch
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.solver import devices
from rotavg_ros.solver.algebra.relaxed_forest import hubs, relaxed_forest
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root, shortest_path_forest
from rotavg_ros.solver.solution import Solution

from .graphs import measured, random_truth, slam_edges

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no usable GPU on this machine")


def _graph(cameras: int = 60, seed: int = 0) -> ViewGraph:
    return PaperRecipe(cameras=(cameras, cameras)).sample(np.random.default_rng(seed)).graph


@pytest.fixture
def fresh(monkeypatch: pytest.MonkeyPatch) -> None:
    """As a process begins: no problem found, none logged."""
    devices.gpu_problem.cache_clear()
    monkeypatch.setattr(devices, "_said", set())


def assert_same(found: Solution, expected: Solution, tolerance: float = 1e-5) -> None:
    assert float(rotations.angle_between(found.body_from_world, expected.body_from_world).max()) < tolerance
    torch.testing.assert_close(found.outlier_score, expected.outlier_score, atol=10 * tolerance, rtol=0)
    assert found.component.tolist() == expected.component.tolist()
    torch.testing.assert_close(found.uncertainty, expected.uncertainty, atol=tolerance, rtol=0, equal_nan=True)


@pytest.mark.usefixtures("fresh")
def test_without_a_gpu_the_cpu_does_it_and_says_so_once(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.version, "cuda", "12.9")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    with caplog.at_level(logging.INFO):
        answers = [solve(_graph(), device="cuda") for _ in range(2)]
    assert [answer.device for answer in answers] == ["cpu", "cpu"]
    assert [record.getMessage() for record in caplog.records] == ["solving on the CPU, not on a GPU: torch finds none"]
    assert_same(answers[0], solve(_graph(), device="cpu"))


@pytest.mark.usefixtures("fresh")
def test_a_wrong_driver_is_named(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    def torch_sees(what: str) -> bool:
        raise RuntimeError(what)

    monkeypatch.setattr(torch.version, "cuda", "12.9")
    monkeypatch.setattr(torch.cuda, "is_available", lambda: torch_sees("The NVIDIA driver is too old\nUpdate it."))
    assert solve(_graph()).device == "cpu"
    expected = "solving on the CPU, not on a GPU: The NVIDIA driver is too old"
    assert [record.getMessage() for record in caplog.records] == [expected]


@pytest.mark.usefixtures("fresh")
def test_a_cpu_build_of_torch_is_silent_unless_a_gpu_was_asked_for(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(torch.version, "cuda", None)
    assert solve(_graph(), device="auto").device == "cpu"
    assert not caplog.records
    assert solve(_graph(), device="cuda").device == "cpu"
    assert len(caplog.records) == 1


@pytest.mark.usefixtures("fresh")
def test_a_gpu_that_runs_out_of_memory(monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture) -> None:
    to = ViewGraph.to

    def onto(graph: ViewGraph, device: torch.device | str) -> ViewGraph:
        if str(device) == "cuda":
            raise torch.OutOfMemoryError("CUDA out of memory. Tried to allocate 2.00 GiB.")
        return to(graph, device)

    monkeypatch.setattr(devices, "gpu_problem", lambda: None)
    monkeypatch.setattr(ViewGraph, "to", onto)
    answer = solve(_graph())
    assert answer.device == "cpu"
    assert "out of memory" in caplog.text
    assert len(caplog.records) == 1
    assert_same(answer, solve(_graph(), device="cpu"))


@settings(max_examples=50)
@given(st.integers(2, 25), st.integers(0, 60), st.integers(0, 10**6))
def test_an_accelerators_tree_is_as_short_as_the_cpus(num_nodes: int, num_edges: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    source = rng.integers(0, num_nodes, num_edges)
    target = (source + rng.integers(1, num_nodes, num_edges)) % num_nodes
    graph = measured(random_truth(num_nodes, seed), source, target)
    cost = torch.from_numpy(rng.choice([0.1, 1.1], num_edges))
    edges, component = SortedEdges.of(graph), graph.components()
    forest = shortest_path_forest(graph, cost)
    tree = relaxed_forest(edges, cost, hubs(edges, component))
    assert tree.roots.tolist() == forest.roots.tolist()
    lengths = []
    for parent, parent_edge in ((forest.parent, forest.parent_edge), (tree.parent.numpy(), tree.parent_edge.numpy())):
        known = type(forest)(parent, parent_edge, forest.component)
        edge_cost = np.where(parent_edge >= 0, np.append(cost.numpy(), 0)[parent_edge], 0.0)
        lengths.append(accumulate_to_root(known, edge_cost))
        child = np.flatnonzero(parent_edge >= 0)
        ends = np.stack((source[parent_edge[child]], target[parent_edge[child]]))
        np.testing.assert_array_equal(np.sort(ends, axis=0), np.sort(np.stack((child, parent[child])), axis=0))
    np.testing.assert_allclose(lengths[1], lengths[0], atol=1e-12)


@pytest.mark.parametrize(("method", "tolerance"), [("neurora", 5e-3), ("neurora-v1", 2e-5), ("chatterjee", 2e-5)])
def test_a_batch_is_its_graphs(method: str, tolerance: float) -> None:
    """Of the default to a tenth of a standard error, which is 2° here."""
    lone = ViewGraph.create([0, 2], [1, 3], [[0, 0, 0.1, 0.995], [0, 0, 0, 1]], num_nodes=6)
    source, target, kind = slam_edges(40, 6, 0)
    slam = measured(random_truth(40, 0), source, target, kind=kind)
    nothing = ViewGraph.create([], [], np.empty((0, 4)), num_nodes=3)
    graphs = [_graph(), slam, lone, _graph(40, 1), nothing]
    answers = solve_batch(graphs, method=method, device="cpu")
    assert [answer.profile for answer in answers] == ["sfm", "slam", "sfm", "sfm", "sfm"]
    for graph, answer in zip(graphs, answers, strict=True):
        assert_same(answer, solve(graph, method=method, device="cpu"), tolerance)
    assert solve_batch([]) == []


@needs_gpu
@pytest.mark.parametrize("recipe", [ReleasedRecipe(cameras=(200, 200)), PaperRecipe(cameras=(300, 300))])
@pytest.mark.parametrize("method", ["neurora", "neurora-v2", "spt"])
def test_a_gpu_says_what_the_cpu_says(recipe: ReleasedRecipe | PaperRecipe, method: str) -> None:
    graph = recipe.sample(np.random.default_rng(0)).graph
    found = solve(graph, method=method, device="cuda")
    assert found.device == "cuda"
    assert found.body_from_world.device.type == "cpu"
    # The trees break ties differently; what is refined does not depend on it.
    if method == "neurora":
        assert_same(found, solve(graph, method=method, device="cpu"), 1e-2)


@needs_gpu
def test_a_batch_on_a_gpu_is_the_batch_on_the_cpu() -> None:
    graphs = [_graph(50 + seed, seed) for seed in range(8)]
    for found, expected in zip(solve_batch(graphs, device="cuda"), solve_batch(graphs, device="cpu"), strict=True):
        assert_same(found, expected, 1e-2)
