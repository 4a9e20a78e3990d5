"""The way of a solve on a GPU, walked on a pretended one: nothing is left behind, nothing goes to and fro."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from rotavg_ros import rotations, solve, solve_batch
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.solver import devices
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

from .pretended_gpu import Traffic, pretended_gpu
from .test_devices import assert_same


def _graph(cameras: int = 50, share: float = 0.4, seed: int = 0) -> ViewGraph:
    recipe = PaperRecipe(cameras=(cameras, cameras), pair_share=(share, share))
    graph = recipe.sample(np.random.default_rng(seed)).graph
    label = torch.where(torch.arange(graph.num_edges) % 50 == 0, EdgeLabel.REJECTED, EdgeLabel.AUTOMATIC)
    return replace(graph, label=label)


@pytest.fixture(autouse=True)
def _a_gpu_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(devices, "gpu_problem", lambda: None)


def _forget(traffic: Traffic) -> None:
    for record in (traffic.to_gpu, traffic.from_gpu, traffic.waits):
        record.clear()


@pytest.mark.parametrize(
    ("method", "waits"),
    [
        pytest.param("neurora", 343, marks=pytest.mark.large),
        ("neurora-v2", 73),
        pytest.param("neurora-round", 344, marks=pytest.mark.large),
    ],
)
def test_a_solve_goes_over_the_bus_once_each_way(method: str, waits: int) -> None:
    graph = _graph()
    with pretended_gpu() as traffic:
        solve(graph, method=method, device="cuda")  # the networks go over once per process
        _forget(traffic)
        found = solve(graph, method=method, device="cuda")
    assert found.device == "cuda"
    assert_same(found, solve(graph, method=method, device="cpu"))
    edges, nodes = graph.num_edges, graph.num_nodes
    # The seven columns of a view-graph, and every node's component.
    to_gpu = [(edges,)] * 6 + [(edges, 4), (nodes,)]
    from_gpu = [(edges,), (nodes, 4)]
    # The components that are left without the rejected edges, which are found on the CPU. All else is of these edges.
    edges = int((graph.label != EdgeLabel.REJECTED).sum())
    to_gpu += [(nodes,)]
    from_gpu += [(edges,)] * 2
    if method != "neurora-v2":
        # Parts that few edges join are looked for on the CPU: in the graph, given its residuals, weights and an answer.
        from_gpu += [(edges,)] * 8 + [(edges, 4), (nodes, 4)]
        # So is how surely they are attached: from the answer, residuals and scores, with shares of one component.
        from_gpu += [(nodes, 4), (nodes,)] + [(edges,)] * 4 + [(1,)] * 2
        to_gpu += [(edges,), (nodes,)]
        # Samples of the uncertainty are drawn there, given edges' ends, weights and components: few, then all.
        from_gpu += [(edges,)] * 6 + [(nodes,)] * 2
        to_gpu += [(nodes, 8), (nodes, 64)]
        from_gpu += [(nodes,)]
    assert sorted(traffic.to_gpu) == sorted(to_gpu)
    assert sorted(traffic.from_gpu) == sorted(from_gpu)
    assert len(traffic.waits) <= waits


@pytest.mark.large
def test_information_goes_along() -> None:
    graph = _graph(30)
    rng = np.random.default_rng(1)
    factors = torch.from_numpy(rng.standard_normal((graph.num_edges, 3, 3)))
    information = factors @ factors.mT + 0.05 * torch.eye(3)
    error = torch.linalg.cholesky(torch.linalg.inv(information)) @ torch.from_numpy(
        0.02 * rng.standard_normal((graph.num_edges, 3, 1))
    )
    truth = rotations.random(graph.num_nodes, generator=torch.Generator().manual_seed(0))
    true = rotations.multiply(truth[graph.target], rotations.inverse(truth[graph.source]))
    measured = rotations.canonical(rotations.multiply(rotations.exp(error.squeeze(2)), true))
    graph = replace(graph, target_from_source=measured, information=information)
    with pretended_gpu():
        found = solve(graph, device="cuda")
    assert_same(found, solve(graph, device="cpu"))
    unstated = solve(replace(graph, information=None), device="cpu")
    assert float(rotations.angle_between(unstated.body_from_world, found.body_from_world).max()) > 1e-3


def test_waits_do_not_grow_with_the_graph() -> None:
    counts = []
    for cameras in (40, 160):
        with pretended_gpu() as traffic:
            solve(_graph(cameras), method="neurora-v2", device="cuda")
        counts.append(len(traffic.waits))
    assert counts[1] <= counts[0] + 2  # a deeper tree takes a round more


@pytest.mark.large
def test_batches_warm_starts_and_loose_graphs_stay_together() -> None:
    """Where the graph is loosely knit, the CPU factorises; the rest is as above."""
    graphs = [_graph(), _graph(40, 0.2, 1), ViewGraph.create([], [], np.empty((0, 4)), num_nodes=3)]
    with pretended_gpu():
        batch = solve_batch(graphs, device="cuda")
        warm = solve(graphs[1], device="cuda", warm_start=batch[1].body_from_world)
    for found, expected in zip(batch, solve_batch(graphs, device="cpu"), strict=True):
        assert_same(found, expected)
    assert_same(warm, solve(graphs[1], device="cpu", warm_start=batch[1].body_from_world))


def test_the_pretended_gpu_refuses_what_a_gpu_refuses() -> None:
    with pretended_gpu() as traffic:
        there, here = torch.ones(3, device="cuda"), torch.ones(3)
        assert (there.device.type, (there * torch.tensor(2.0)).device.type) == ("cuda", "cuda")
        with pytest.raises(RuntimeError, match="same device"):
            there + here
        with pytest.raises(RuntimeError, match="same device"):
            there[torch.tensor([0])] = 1.0
        with pytest.raises(TypeError, match="numpy"):
            there.numpy()
        assert not (traffic.waits or traffic.from_gpu)
        assert bool((there.cpu() == here).all())
        assert float(there[there > 0].sum()) == 3
        assert (traffic.waits, traffic.from_gpu) == (["__getitem__", "__float__"], [(3,)])
        rotations.to_matrix(rotations.identity(2, device="cuda"))
        assert not traffic.to_gpu
