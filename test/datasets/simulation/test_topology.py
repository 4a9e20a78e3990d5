"""Synthetic rotations on given topologies."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import networkx as nx
import numpy as np
import pytest

from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.datasets.simulation.topology import ClusteredTopology, Topology, read_topology
from rotavg_ros.metrics import true_edge_noise


@pytest.mark.parametrize("recipe", [ReleasedRecipe(), PaperRecipe()], ids=["released", "paper"])
def test_the_topology_is_kept(recipe: ReleasedRecipe | PaperRecipe) -> None:
    topology = Topology(5, np.array([0, 1, 4]), np.array([1, 2, 3]))
    drawn = topology.sample(recipe, np.random.default_rng(0))
    graph = drawn.graph
    assert graph.num_nodes == 5
    assert graph.source.tolist() == [0, 1, 4]
    assert graph.target.tolist() == [1, 2, 3]
    noise = true_edge_noise(graph, drawn.body_from_world)
    np.testing.assert_allclose(noise, drawn.noise_angle, atol=1e-7)


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"nodes": 3, "source": [0, 1]}, "not a topology: target"),
        ({"nodes": 2, "source": [0, 1], "target": [1, 2]}, "nodes in 0 … 1"),
        ({"nodes": 3, "source": [0, 1], "target": [1]}, "equally many"),
    ],
)
def test_what_is_no_topology_is_told(tmp_path: Path, arrays: dict[str, Any], message: str) -> None:
    path = tmp_path / "topology.npz"
    np.savez(path, **arrays)
    with pytest.raises(GraphFileError, match=message):
        read_topology(path)


def test_real_topology(shared_data: Path) -> None:
    topology = read_topology(shared_data / "sfm" / "topology" / "Madrid_Metropolis.npz")
    drawn = topology.sample(PaperRecipe(), np.random.default_rng(0))
    assert (drawn.graph.num_nodes, drawn.graph.num_edges) == (394, 23784)
    assert int(drawn.graph.components().max()) == 0


def test_drawn_topologies_are_like_those_of_photo_collections() -> None:
    rng = np.random.default_rng(0)
    clustering = []
    for _ in range(8):
        topology = ClusteredTopology().sample(120, rng)
        graph = nx.Graph(zip(topology.source.tolist(), topology.target.tolist(), strict=True))
        assert len(graph) == 120
        assert nx.is_connected(graph)
        assert graph.number_of_edges() == len(topology.source)  # no pair twice
        degree = np.array([count for _, count in graph.degree()])
        assert np.percentile(degree, 5) < 0.5 * np.median(degree)
        clustering.append(nx.transitivity(graph))
    assert 0.5 < np.mean(clustering) < 0.9
