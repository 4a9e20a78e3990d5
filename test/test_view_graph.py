"""ViewGraph: what it accepts, refuses and says of its connectivity."""

from __future__ import annotations

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros import EdgeKind, ViewGraph, ViewGraphError

_UNIT = [0.0, 0.0, 0.0, 1.0]


def test_defaults() -> None:
    graph = ViewGraph.create([0, 1], [1, 2], [_UNIT, [0, 0, 0, -1]])
    assert (graph.num_nodes, graph.num_edges) == (3, 2)
    assert graph.kind.tolist() == [EdgeKind.LOOP_CLOSURE] * 2
    assert torch.isnan(graph.precision).all()
    assert graph.target_from_source[:, 3].tolist() == [1, 1]
    assert graph.target_from_source.dtype == torch.float64


def test_no_edges_and_no_nodes() -> None:
    assert ViewGraph.create([], [], np.empty((0, 4))).num_nodes == 0
    assert ViewGraph.create([], [], np.empty((0, 4)), num_nodes=2).components().tolist() == [0, 1]


@pytest.mark.parametrize(
    ("source", "target", "quaternion", "message"),
    [
        ([0, 1], [1, 1], [_UNIT, _UNIT], "edge 1 has the same source and target"),
        ([0, -1], [1, 0], [_UNIT, _UNIT], "edge 1 has a node index outside"),
        ([0], [5], [_UNIT], "edge 0 has a node index outside 0 … 2"),
        ([0], [1], [[0, 0, 0, 0]], "edge 0 has a quaternion that is not of unit length"),
        ([0], [1], [[0, 0, np.nan, 1]], "edge 0 has a quaternion that is not of unit length"),
        ([0], [1], [[0, 0, 0, 1.01]], "edge 0 has a quaternion that is not of unit length"),
        ([0, 1], [1], [_UNIT], "target has 1 rows, source has 2"),
    ],
)
def test_refuses(source: list[int], target: list[int], quaternion: list[list[float]], message: str) -> None:
    with pytest.raises(ViewGraphError, match=message):
        ViewGraph.create(source, target, quaternion, num_nodes=3)


def test_normalises_within_tolerance_and_forgets_impossible_precisions() -> None:
    graph = ViewGraph.create([0, 0, 0, 0], [1, 1, 1, 1], [[0, 0, 0, 1.0005]] * 4, precision=[4, 0, -1, np.inf])
    assert graph.target_from_source.norm(dim=1).tolist() == pytest.approx([1] * 4)
    assert torch.isnan(graph.precision).tolist() == [False, True, True, True]


@given(st.integers(1, 20), st.lists(st.tuples(st.integers(0, 19), st.integers(0, 19)), max_size=30))
def test_components_are_networkxs(num_nodes: int, pairs: list[tuple[int, int]]) -> None:
    edges = [(a % num_nodes, b % num_nodes) for a, b in pairs if a % num_nodes != b % num_nodes]
    source, target = ([e[i] for e in edges] for i in (0, 1))
    graph = ViewGraph.create(source, target, [_UNIT] * len(edges) or np.empty((0, 4)), num_nodes=num_nodes)
    component = graph.components().tolist()
    reference = networkx.Graph(edges)
    reference.add_nodes_from(range(num_nodes))
    groups = sorted(networkx.connected_components(reference), key=min)
    assert [component[node] for group in groups for node in sorted(group)] == [
        number for number, group in enumerate(groups) for _ in group
    ]


def test_select_edges() -> None:
    graph = ViewGraph.create([0, 1, 2], [1, 2, 3], [_UNIT] * 3, kind=[0, 1, 0], precision=[1, 2, 3])
    chosen = graph.select_edges(graph.is_odometry)
    assert chosen.num_nodes == 4 and chosen.source.tolist() == [0, 2] and chosen.precision.tolist() == [1, 3]
