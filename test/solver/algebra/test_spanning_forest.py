"""Spanning forests against scipy, networkx and truth."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations
from rotavg_ros.solver.algebra.spanning_forest import (
    accumulate_to_root,
    compose_orientations,
    minimum_spanning_forest,
    shortest_path_forest,
)
from test.solver.graphs import as_quaternions, measured, random_truth


def _random_graph(num_nodes: int, num_edges: int, seed: int) -> tuple[ViewGraph, Rotation]:
    rng = np.random.default_rng(seed)
    source = rng.integers(0, num_nodes, num_edges)
    target = (source + rng.integers(1, num_nodes, num_edges)) % num_nodes
    truth = random_truth(num_nodes, seed)
    return measured(truth, source, target), truth


@given(st.integers(2, 25), st.integers(0, 60), st.integers(0, 10**6))
def test_forests_reproduce_exact_measurements(num_nodes: int, num_edges: int, seed: int) -> None:
    graph, truth = _random_graph(num_nodes, num_edges, seed)
    cost = torch.from_numpy(np.random.default_rng(seed).uniform(0.1, 5, num_edges))
    forests = [shortest_path_forest(graph), shortest_path_forest(graph, cost), minimum_spanning_forest(graph, cost)]
    component = graph.components().numpy()
    for forest in forests:
        assert np.array_equal(forest.component, component)
        assert len(forest.roots) == component.max() + 1
        composed = compose_orientations(forest, graph)
        # Exact up to the gauge: each root is the identity.
        root = forest.roots[component]
        relative = rotations.multiply(rotations.inverse(composed), as_quaternions(truth))
        gauge = rotations.multiply(rotations.inverse(composed[root]), as_quaternions(truth[root]))
        assert float(rotations.angle_between(relative, gauge).max()) < 1e-6


@given(st.integers(2, 20), st.integers(1, 60), st.integers(0, 10**6))
def test_shortest_paths_are_networkxs(num_nodes: int, num_edges: int, seed: int) -> None:
    graph, _ = _random_graph(num_nodes, num_edges, seed)
    cost = np.random.default_rng(seed).uniform(0.1, 5, num_edges)
    forest = shortest_path_forest(graph, torch.from_numpy(cost), root="first")
    edge_cost = np.where(forest.parent_edge >= 0, cost[forest.parent_edge], 0)
    length = accumulate_to_root(forest, edge_cost)
    reference = networkx.MultiGraph()
    reference.add_nodes_from(range(num_nodes))
    for source, target, weight in zip(graph.source.tolist(), graph.target.tolist(), cost, strict=True):
        reference.add_edge(source, target, weight=weight)
    for root in forest.roots:
        for node, expected in networkx.single_source_dijkstra_path_length(reference, root).items():
            assert length[node] == pytest.approx(expected)


@given(st.integers(2, 20), st.integers(1, 60), st.integers(0, 10**6))
def test_minimum_spanning_forest_has_networkxs_cost(num_nodes: int, num_edges: int, seed: int) -> None:
    graph, _ = _random_graph(num_nodes, num_edges, seed)
    cost = np.random.default_rng(seed).uniform(0.1, 5, num_edges)
    forest = minimum_spanning_forest(graph, torch.from_numpy(cost))
    reference = networkx.MultiGraph()
    for source, target, weight in zip(graph.source.tolist(), graph.target.tolist(), cost, strict=True):
        reference.add_edge(source, target, weight=weight)
    expected = networkx.minimum_spanning_tree(reference).size(weight="weight")
    assert cost[forest.parent_edge[forest.parent_edge >= 0]].sum() == pytest.approx(expected)


def test_breadth_first_tree_starts_at_the_hub() -> None:
    truth = random_truth(6, 0)
    graph = measured(truth, np.array([3, 3, 3, 0, 4]), np.array([0, 1, 2, 1, 5]))
    forest = shortest_path_forest(graph)
    assert forest.roots.tolist() == [3, 4]
    assert forest.parent.tolist() == [3, 3, 3, 3, 4, 4]


def test_a_chain_of_ten_thousand_keeps_double_precision() -> None:
    truth = random_truth(10_001, 1)
    graph = measured(truth, np.arange(10_000), np.arange(1, 10_001))
    composed = compose_orientations(minimum_spanning_forest(graph, torch.ones(10_000)), graph)
    expected = as_quaternions(truth)
    gauge = rotations.multiply(rotations.inverse(expected[0]), composed[0])
    assert float(rotations.angle_between(composed, rotations.multiply(expected, gauge)).max()) < 1e-10
