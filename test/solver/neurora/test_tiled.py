"""The engine of solves against the networks as they are written down, and what it walks along."""

from __future__ import annotations

from collections.abc import Iterator
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros import ViewGraph, rotations
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.solver.algebra.residuals import EdgeResiduals, edge_residual
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.networks import NETWORKS
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.fine_net import edge_features
from rotavg_ros.solver.neurora.message_passing import DirectedEdges, MessagePassingNetwork, Wiring
from rotavg_ros.solver.neurora.network_store import load_network
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.neurora.tiled import passes as inference
from rotavg_ros.solver.neurora.tiled import tuning
from rotavg_ros.solver.neurora.tiled.networks import clean_edges, fine_tuned
from rotavg_ros.solver.neurora.tiled.passes import Tuning
from rotavg_ros.solver.running.threads import workers

SIZES = st.tuples(st.integers(2, 40), st.integers(1, 150), st.integers(0, 10**6))


@pytest.fixture(autouse=True)
def _tuning_as_before() -> Iterator[None]:
    before = inference.current_tuning()
    yield
    inference.set_tuning(before)


def _random_graph(num_nodes: int, num_edges: int, seed: int) -> ViewGraph:
    """Parallel edges, hubs (low numbers are likelier) and nodes without edges."""
    rng = np.random.default_rng(seed)
    source = (num_nodes * rng.random(num_edges) ** 3).astype(np.int64)
    target = (source + rng.integers(1, num_nodes, num_edges)) % num_nodes
    return ViewGraph.create(
        source, target, Rotation.random(num_edges, random_state=seed).as_quat(), num_nodes=num_nodes
    )


@settings(max_examples=12)
@given(SIZES, st.integers(1, 40), st.integers(1, 3))
def test_both_networks_are_their_forward(size: tuple[int, int, int], tile_edges: int, threads: int) -> None:
    """In double precision, where nothing but rounding could differ, on the wildest of graphs."""
    graph = _random_graph(*size)
    start = rotations.random(graph.num_nodes, generator=torch.Generator().manual_seed(size[2]))
    inference.set_tuning(Tuning(tile_edges, threads))
    before = torch.get_num_threads()
    torch.set_num_threads(threads)
    try:
        probability, clean, fine = _differences(graph, start, torch.float64)
        assert torch.get_num_threads() == threads
    finally:
        torch.set_num_threads(before)
    assert max(probability, clean, fine) < 1e-9


@pytest.mark.parametrize("recipe", [PaperRecipe((250, 250)), ReleasedRecipe((250, 250))], ids=["paper", "released"])
def test_single_precision_is_exact_to_a_hundred_thousandth(recipe: PaperRecipe | ReleasedRecipe) -> None:
    sample = recipe.sample(np.random.default_rng(0))
    assert max(_differences(sample.graph, sample.body_from_world, torch.float32)) < 1e-5


@torch.no_grad()
def _differences(graph: ViewGraph, start: Tensor, dtype: torch.dtype) -> tuple[float, float, float]:
    """The engine against ``forward``: outlier probabilities, corrected measurements, corrected orientations."""
    clean_net, fine_net = (
        deepcopy(load_network(NETWORKS[name])).to(dtype) for name in ("sfm-clean-net", "sfm-fine-net")
    )
    measured, start, component = graph.target_from_source.to(dtype), start.to(dtype), graph.components()
    directed = DirectedEdges.of(graph.source, graph.target, graph.num_nodes, dtype)
    expected = clean_net(measured, directed)
    rectified, logit = expected.target_from_source, expected.outlier_logit
    edges = SortedEdges.of(graph)
    after = replace(graph, target_from_source=rectified)
    cleaned = Cleaned(after, replace(graph, target_from_source=measured), logit.sigmoid(), edges)
    inliers = graph.select_edges(cleaned.is_inlier.nonzero().squeeze(1))
    raw, clean = (
        rotations.canonical(edge_residual(start, relative[cleaned.is_inlier], inliers.source, inliers.target)).t()[:3]
        for relative in (measured, rectified)
    )
    scale = torch.stack([_median_length(raw, component[inliers.source] == number) for number in component])[:, None]
    of_inliers = cleaned.outlier_probability[cleaned.is_inlier].logit()
    features = edge_features(raw, clean, of_inliers, scale[inliers.source, 0]).t()
    directed = DirectedEdges.of(inliers.source, inliers.target, graph.num_nodes, dtype)
    with workers():
        found = clean_edges(clean_net, measured, edges)
        fine = fine_tuned(fine_net, cleaned, start, component)
    return (
        float((found.outlier_logit.sigmoid() - logit.sigmoid()).abs().max()),
        _apart(found.target_from_source, rectified),
        _apart(fine, fine_net(start, features, scale, directed)),
    )


def _median_length(vectors: Tensor, chosen: Tensor) -> Tensor:
    """Of the chosen columns of ``(3, k)``; as little as it may be where none is chosen."""
    length = vectors[:, chosen].norm(dim=0)
    return length.median().clamp(min=NUMBERS.min_residual) if len(length) else length.new_tensor(NUMBERS.min_residual)


def _apart(found: Tensor, expected: Tensor) -> float:
    """Largest difference of a component; quaternions near w = 0 may take either sign."""
    sign = (found * expected).sum(dim=1, keepdim=True).sign()
    return float((found * sign - expected).abs().max())


@torch.no_grad()
@pytest.mark.parametrize("wiring", [Wiring(), Wiring(accumulates=True), Wiring(remembers=False)])
def test_any_widths_and_any_subset_of_the_edges(wiring: Wiring) -> None:
    graph = _random_graph(20, 80, 0)
    kept = torch.from_numpy(np.random.default_rng(1).random(80) < 0.6)
    torch.manual_seed(0)
    network = MessagePassingNetwork(
        node_width=3, edge_width=7, hidden_width=16, num_layers=3, odd_width=5, wiring=wiring
    )
    states, features = torch.randn(20, 3), torch.randn(80, 7)
    few = graph.select_edges(kept)
    turned = features[kept] * torch.tensor([-1.0] * 5 + [1.0] * 2)
    directed = DirectedEdges.of(few.source, few.target, 20)
    expected, _ = network(states, torch.cat((features[kept], turned)), directed)
    actual = inference.node_states(network, states, features, SortedEdges.of(graph).select(kept))
    torch.testing.assert_close(actual, expected, atol=1e-5, rtol=1e-5)
    nothing = SortedEdges.of(graph).select(torch.zeros(80, dtype=torch.bool))
    lonely, _ = network(states, features[:0], DirectedEdges.of(few.source[:0], few.target[:0], 20))
    torch.testing.assert_close(inference.node_states(network, states, features, nothing), lonely)


@settings(max_examples=50)
@given(SIZES, st.integers(1, 60))
def test_tiles_have_every_edge_once_and_all_of_a_node(size: tuple[int, int, int], tile_edges: int) -> None:
    graph = _random_graph(*size)
    edges = SortedEdges.of(graph)
    target, edge = edges.target().numpy(), edges.edge.numpy()
    ends = np.where(edges.is_reversed.numpy(), graph.source.numpy()[edge], graph.target.numpy()[edge])
    starts = np.where(edges.is_reversed.numpy(), graph.target.numpy()[edge], graph.source.numpy()[edge])
    np.testing.assert_array_equal(target, ends)
    np.testing.assert_array_equal(edges.source.numpy(), starts)
    tiles = edges.tiles(tile_edges)
    assert [tile.nodes.start for tile in tiles] == [0, *(tile.nodes.stop for tile in tiles[:-1])]
    assert tiles[-1].nodes.stop == graph.num_nodes
    for tile in tiles:
        inside = (target >= tile.nodes.start) & (target < tile.nodes.stop)
        np.testing.assert_array_equal(np.flatnonzero(inside), np.arange(len(target))[tile.edges])
        assert tile.edges.stop - tile.edges.start <= tile_edges + edges.degree.max()


@given(SIZES)
def test_residuals_are_scipys(size: tuple[int, int, int]) -> None:
    graph = _random_graph(*size)
    truth = Rotation.random(graph.num_nodes, random_state=size[2])
    source, target = graph.source.numpy(), graph.target.numpy()
    expected = truth[target].inv() * Rotation.from_quat(graph.target_from_source.numpy()) * truth[source]
    residuals = EdgeResiduals(graph, torch.from_numpy(truth.as_quat()))
    every = slice(0, graph.num_edges)
    angle = expected.magnitude()
    np.testing.assert_allclose(residuals.angles().numpy(), angle, atol=1e-12)
    apart = Rotation.from_rotvec(residuals.vectors(every).numpy().T).inv() * expected
    assert apart.magnitude().max() < 1e-7
    assert float(residuals.quaternions(every)[3].min()) >= 0


def test_exact_measurements_leave_exactly_nothing() -> None:
    graph = ViewGraph.create([0], [1], [[0.0, 0.0, 0.0, 1.0]])
    residuals = EdgeResiduals(graph, rotations.identity(2))
    assert residuals.vectors(slice(0, 1)).tolist() == [[0.0]] * 3


def test_tuning_takes_one_of_its_choices() -> None:
    before = inference.current_tuning()
    with workers():
        chosen = tuning.measure(num_edges=200)
    inference.set_tuning(before)
    assert chosen.tile_edges in (4096, 8192, 16384)
    assert chosen.threads in (1, torch.get_num_threads())
    assert tuning.tune() == inference.current_tuning()
