"""The paper's networks, tree and loss against their formulas, edge by edge, and against networkx."""

from __future__ import annotations

import networkx as nx
import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import ViewGraph, rotations
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.message_passing import DirectedEdges
from rotavg_ros.solver.neurora.paper import PaperCleanNet, PaperFineNet, paper_fine_tune
from rotavg_ros.solver.neurora.stages import clean
from rotavg_ros.solver.neurora.tree import breadth_first
from rotavg_ros.training.losses import paper_fine_net_loss


def _random_graph(num_nodes: int, num_edges: int, seed: int) -> ViewGraph:
    rng = np.random.default_rng(seed)
    source = rng.integers(0, num_nodes, num_edges)
    target = (source + rng.integers(1, num_nodes, num_edges)) % num_nodes
    return ViewGraph.create(
        source, target, Rotation.random(num_edges, random_state=seed).as_quat(), num_nodes=num_nodes
    )


def _judged(graph: ViewGraph, seed: int) -> Cleaned:
    probability = torch.rand(graph.num_edges, generator=torch.Generator().manual_seed(seed))
    return Cleaned(graph, graph, probability, SortedEdges.of(graph))


def _shaken(network: torch.nn.Module) -> torch.nn.Module:
    """With heads that say something; FineNet's begin as nothing."""
    generator = torch.Generator().manual_seed(1)
    for parameter in network.parameters():
        parameter.data += 0.1 * torch.randn(parameter.shape, generator=generator)
    return network


@torch.no_grad()
def test_layers_see_an_edge_and_the_states_of_its_ends_and_nothing_else() -> None:
    """Message passing written down once more, node by node; the last node has no edge."""
    graph = _random_graph(9, 20, 0)
    network = _shaken(PaperFineNet())
    start = rotations.random(10, generator=torch.Generator().manual_seed(2)).float()
    residual = graph.target_from_source.float()
    edges = DirectedEdges.of(graph.source, graph.target, 10)
    features = torch.cat((residual, rotations.inverse(residual)))
    states = start
    for layer in network.network.layers:  # type: ignore[union-attr]
        rows = []
        for node in range(10):
            arriving = (edges.target == node).nonzero().flatten()
            message = torch.zeros(32)
            for edge in arriving.tolist():
                inner = layer.edge_projection(features[edge])
                inner = inner + layer.target_projection(states[node])
                inner = inner + layer.source_projection(states[edges.source[edge]])
                message = message + layer.message_output(torch.relu(inner)) / len(arriving)
            rows.append(torch.relu(layer.update(torch.cat((states[node], message)))))
        states = torch.stack(rows)
    change = network.correction_head(states) + torch.tensor([0.0, 0.0, 0.0, 1.0])  # type: ignore[operator]
    correction = Rotation.from_quat(change.numpy())
    expected = (Rotation.from_quat(start.numpy()) * correction).as_quat()
    found = network(start, residual, edges)
    sign = np.sign((found.numpy() * expected).sum(axis=1, keepdims=True))
    np.testing.assert_allclose(found.numpy() * sign, expected, atol=1e-5)


@settings(max_examples=20)
@given(st.integers(3, 30), st.integers(1, 120), st.integers(0, 10**6))
def test_solves_run_the_formula_over_the_inliers(num_nodes: int, num_edges: int, seed: int) -> None:
    graph = _random_graph(num_nodes, num_edges, seed)
    cleaned = _judged(graph, seed)
    network = _shaken(PaperFineNet())
    assert isinstance(network, PaperFineNet)
    start = rotations.random(num_nodes, generator=torch.Generator().manual_seed(seed))
    inliers = graph.select_edges(cleaned.is_inlier.nonzero().squeeze(1))
    at_source, at_target = start[inliers.source], start[inliers.target]
    residual = rotations.multiply(
        rotations.inverse(at_target), rotations.multiply(inliers.target_from_source, at_source)
    )
    edges = DirectedEdges.of(inliers.source, inliers.target, num_nodes)
    with torch.no_grad():
        expected = network(rotations.canonical(start).float(), rotations.canonical(residual).float(), edges)
    assert float(rotations.angle_between(paper_fine_tune(network, cleaned, start), expected.double()).max()) < 1e-3


def test_clean_net_is_blind_to_directions() -> None:
    graph = _random_graph(12, 40, 3)
    turned = ViewGraph.create(
        graph.target, graph.source, rotations.inverse(graph.target_from_source), num_nodes=graph.num_nodes
    )
    network = PaperCleanNet()
    one, other = clean(network, graph), clean(network, turned)
    torch.testing.assert_close(one.outlier_probability, other.outlier_probability)
    back = rotations.inverse(other.graph.target_from_source)
    assert float(rotations.angle_between(one.graph.target_from_source, back).max()) < 1e-3


@settings(max_examples=40)
@given(st.integers(2, 25), st.integers(1, 80), st.integers(0, 10**6))
def test_the_tree_is_breadth_first_over_inliers(num_nodes: int, num_edges: int, seed: int) -> None:
    graph = _random_graph(num_nodes, num_edges, seed)
    cleaned = _judged(graph, seed)
    begun = breadth_first(cleaned)
    inlier = cleaned.is_inlier
    ends = list(zip(graph.source.tolist(), graph.target.tolist(), strict=True))
    inliers, everything = nx.MultiGraph(), nx.MultiGraph()
    for network in (inliers, everything):
        network.add_nodes_from(range(num_nodes))
    everything.add_edges_from(ends)
    inliers.add_edges_from(end for end, is_inlier in zip(ends, inlier.tolist(), strict=True) if is_inlier)
    for root in begun.roots.tolist():
        members = nx.node_connected_component(everything, root)
        assert inliers.degree[root] == max(inliers.degree[node] for node in members)
        hops = nx.single_source_shortest_path_length(inliers, root)
        for node in members:
            edges, at = [], node
            while int(begun.parent_edge[at]) >= 0:
                edges.append(int(begun.parent_edge[at]))
                at = int(begun.parent[at])
            assert at == root
            if node in hops:  # else outliers alone lead there
                assert len(edges) == hops[node]
                assert bool(inlier[edges].all())
            relative = Rotation.identity()
            here = node
            for edge in edges:
                measured = Rotation.from_quat(graph.target_from_source[edge].numpy())
                relative = relative * (measured if int(graph.target[edge]) == here else measured.inv())
                here = int(begun.parent[here])
            difference = relative * Rotation.from_quat(begun.body_from_world[node].numpy()).inv()
            assert difference.magnitude() < 1e-6


def test_the_loss_is_equation_10() -> None:
    graph = _random_graph(7, 15, 4)
    generator = torch.Generator().manual_seed(5)
    truth, estimate = rotations.random(7, generator=generator), rotations.random(7, generator=generator)
    edges = DirectedEdges.of(graph.source, graph.target, 7)
    found = paper_fine_net_loss(estimate, truth, edges)

    def distance(a: Rotation, b: Rotation) -> float:
        p, q = a.as_quat(), b.as_quat()
        return float(min(np.linalg.norm(p - q), np.linalg.norm(p + q)))

    nodes, true_nodes = Rotation.from_quat(estimate.numpy()), Rotation.from_quat(truth.numpy())
    of_node: list[list[float]] = [[] for _ in range(7)]
    for source, target in zip(graph.source.tolist(), graph.target.tolist(), strict=True):
        value = distance(nodes[target] * nodes[source].inv(), true_nodes[target] * true_nodes[source].inv())
        of_node[source].append(value)
        of_node[target].append(value)
    edge = float(np.mean([np.mean(values) for values in of_node if values]))
    node = float(np.mean([distance(nodes[v], true_nodes[v]) for v in range(7)]))
    assert float(found["loss"]) == pytest.approx(edge + 0.1 * node, rel=1e-4)
    assert float(paper_fine_net_loss(truth, truth, edges)["loss"]) < 1e-3
    gauge = rotations.random(1, generator=generator)
    turned = paper_fine_net_loss(rotations.multiply(truth, gauge), truth, edges)
    assert float(turned["edge"]) < 1e-3 < float(turned["node"])
    assert float(orientation_errors(rotations.multiply(truth, gauge), truth).max()) < 1e-6
