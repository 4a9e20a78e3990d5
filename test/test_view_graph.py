"""ViewGraph: what it accepts, refuses and says of its connectivity."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import networkx
import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, ViewGraphError
from rotavg_ros.view_graph import EdgeLabel

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
        ([0, -1], [1, 0], [_UNIT, _UNIT], "edge 1 has node -1; node indices count from 0"),
        ([0], [5], [_UNIT], "edge 0 has node 5; with num_nodes 3 indices are 0 … 2"),
        (
            [0],
            [1],
            [[0, 0, 0, 0]],
            "edge 0 has a quaternion of length 0 in target_from_source; it must be fi",
        ),
        (
            [0, 1],
            [1, 2],
            [_UNIT, [0, 0, np.nan, 1]],
            "edge 1 has a quaternion of length nan in target_from_source; it must be finite",
        ),
        (
            [0],
            [1],
            [[0, 0, 0, np.inf]],
            "edge 0 has a quaternion of length inf in target_from_source; it must be finite",
        ),
        ([0], [1], [[0, 0, 0, 1.01]], "edge 0 has a quaternion of length 1.01 in target_from_source"),
        ([0, 1], [1], [_UNIT], "target has 1 rows, source has 2; they must agree"),
        ([0, 1], [1, 2], [_UNIT], "target_from_source has 1 rows, source has 2; they must agree"),
        ([0.0, 1.5], [1, 2], [_UNIT] * 2, "source holds 1.5; it must hold whole numbers"),
        ([0, np.nan], [1, 2], [_UNIT] * 2, "source holds nan; it must hold whole numbers"),
        ([0], torch.tensor([1e30]), [_UNIT], "target holds 1e+30; it must hold whole numbers"),
        (torch.tensor([1j]), [1], [_UNIT], "source holds complex numbers; it must hold real ones"),
        ([0], [2**63], [_UNIT], "target holds 9223372036854775808, which is too large"),
        ([[0]], [1], [_UNIT], "source has shape (1, 1); it must be (M,), one entry per edge"),
        (0, 1, [_UNIT], "source has shape (); it must be (M,), one entry per edge"),
        ([0], [1], _UNIT, "target_from_source has shape (4,); it must be (M, 4), quaternions xyzw, or (M, 3, 3)"),
        ([0, 1], [1, 2], [_UNIT, [0, 0, 1]], "target_from_source is not an array; its rows must have the same length"),
        ([0], [1], [["a", "b", "c", "d"]], "target_from_source holds <U1; it must hold numbers"),
        ([0], [1], [np.diag([1.0, 1, -1])], "edge 0 has a matrix in target_from_source that is not a rotation"),
        ([0], [1], [1.01 * np.eye(3)], "edge 0 has a matrix in target_from_source that is not a rotation"),
        ([0], [1], [np.full((3, 3), np.nan)], "edge 0 has a matrix in target_from_source that is not a rotation"),
    ],
)
def test_refuses_what_makes_no_graph(source: Any, target: Any, quaternion: Any, message: str) -> None:
    with pytest.raises(ViewGraphError) as caught:
        ViewGraph.create(source, target, quaternion, num_nodes=3)
    assert str(caught.value).startswith(message)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"kind": [5]}, "edge 0 has kind 5; 0 is odometry, 1 a loop closure"),
        ({"kind": [-1]}, "edge 0 has kind -1"),
        ({"kind": [0, 1]}, "kind has 2 rows, source has 1"),
        ({"kind": ["closure"]}, "kind holds <U7; it must hold numbers"),
        ({"label": [3]}, "edge 0 has label 3; 0 is automatic, 1 accepted, 2 rejected"),
        ({"precision": [[1.0]]}, "precision has shape (1, 1)"),
        ({"precision": ["much"]}, "precision holds <U4; it must hold numbers"),
        ({"steps": [0]}, "edge 0 has 0 steps; they must be between 1e-09 and 1e+09"),
        ({"steps": [1e40]}, "edge 0 has 1e+40 steps; they must be between 1e-09 and 1e+09"),
        ({"steps": [1e-300]}, "edge 0 has 1e-300 steps"),
        ({"steps": [np.nan]}, "edge 0 has nan steps"),
        ({"num_nodes": -1}, "num_nodes is -1"),
        ({"num_nodes": 3.0}, "num_nodes is 3.0; it must be a whole number"),
        ({"num_nodes": "3"}, "num_nodes is '3'; it must be a whole number"),
        ({"num_nodes": 2**31}, "num_nodes is 2147483648; it must be 0 … 2147483647"),
    ],
)
def test_refuses_what_is_said_of_an_edge(given: dict[str, Any], message: str) -> None:
    with pytest.raises(ViewGraphError) as caught:
        ViewGraph.create([0], [1], [_UNIT], **given)
    assert str(caught.value).startswith(message)


def test_ids_are_no_indices() -> None:
    for largest in (10**12, 2**31, 10**6):
        with pytest.raises(ViewGraphError, match=f"largest index is {largest}, but there are only 1 edges; number the"):
            ViewGraph.create([0], [largest], [_UNIT])
    # What is said to be meant is meant, and gaps of a thousand are nothing.
    assert ViewGraph.create([0], [10**6], [_UNIT], num_nodes=10**6 + 1).num_nodes == 10**6 + 1
    for whole in (np.int32(3), torch.tensor(3)):
        assert type(ViewGraph.create([0], [1], [_UNIT], num_nodes=whole).num_nodes) is int
    assert ViewGraph.create([3], [1000], [_UNIT]).num_nodes == 1001


@pytest.mark.parametrize("form", [list, np.array, torch.tensor, lambda values: np.array(values, dtype=np.float32)])
def test_rotations_in_every_form_and_direction(form: Callable[[Any], Any]) -> None:
    """The 30° to the left of the README's example, beside a turn about another axis and the largest one."""
    source_from_target = Rotation.from_rotvec([[0, 0, np.pi / 6], [1.2, -0.3, 0.8], [0, np.pi, 0]])
    target_from_source = source_from_target.inv()
    for rotations in (
        {"target_from_source": form(target_from_source.as_quat().tolist())},
        {"source_from_target": form(source_from_target.as_quat().tolist())},
        {"target_from_source": form(target_from_source.as_matrix().tolist())},
        {"source_from_target": form(source_from_target.as_matrix().tolist())},
    ):
        graph = ViewGraph.create(np.array([0, 1, 2], dtype=np.int32), [1, 2, 3], **rotations)
        found = Rotation.from_quat(graph.target_from_source.numpy())
        assert (found * source_from_target).magnitude().max() < 1e-6
        assert graph.target_from_source.dtype == torch.float64 and (graph.target_from_source[:, 3] >= 0).all()


def test_whole_numbers_may_come_as_floats() -> None:
    """As columns that numpy.loadtxt has read do."""
    graph = ViewGraph.create(np.array([0.0, 1.0]), torch.tensor([1.0, 2.0]), [_UNIT] * 2, kind=np.zeros(2))
    assert graph.source.tolist() == [0, 1] and graph.target.tolist() == [1, 2] and graph.kind.tolist() == [0, 0]


def test_exactly_one_direction() -> None:
    for rotations in ({}, {"target_from_source": [_UNIT], "source_from_target": [_UNIT]}):
        with pytest.raises(ViewGraphError, match=r"give either target_from_source or source_from_target .* not both"):
            ViewGraph.create([0], [1], **rotations)


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


def test_a_rejected_edge_tells_no_dimension_unless_it_alone_joins_parts() -> None:
    flat, tilted = [0.0, 0.0, 0.1, 0.99**0.5], [0.1, 0.0, 0.0, 0.99**0.5]
    label = [EdgeLabel.AUTOMATIC, EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED]
    within = ViewGraph.create([0, 1, 0], [1, 2, 2], [flat, flat, tilted], label=label)
    assert within.rotation_components == 1
    assert replace(within, label=torch.zeros(3, dtype=torch.int64)).rotation_components == 3
    between = ViewGraph.create([0, 2, 1], [1, 3, 2], [flat, flat, tilted], label=label)
    assert between.rotation_components == 3


def test_select_edges() -> None:
    graph = ViewGraph.create([0, 1, 2], [1, 2, 3], [_UNIT] * 3, kind=[0, 1, 0], precision=[1, 2, 3])
    chosen = graph.select_edges(graph.is_odometry)
    assert chosen.num_nodes == 4 and chosen.source.tolist() == [0, 2] and chosen.precision.tolist() == [1, 3]
    first = graph.first_edges(1, torch.tensor([2]))
    assert first.num_nodes == 4 and first.source.tolist() == [0, 2] and first.precision.tolist() == [1, 3]


def test_translations_that_cannot_be_are_unknown() -> None:
    translation = [[1.0, 2.0, 3.0], [1e300, 0.0, 0.0], [0.0, np.inf, 0.0]]
    graph = ViewGraph.create([0, 1, 2], [1, 2, 3], [[0.0, 0.0, 0.0, 1.0]] * 3, translation=translation)
    assert graph.translation is not None
    assert graph.translation.isfinite().all(dim=1).tolist() == [True, False, False]


def test_information_that_is_no_information_is_unknown() -> None:
    """Not finite, not positive definite, or singular but for rounding; of others the symmetric part counts."""
    skew = [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 0.0]]
    stated = np.array([np.diag([1.0, 2.0, 4.0]) + skew, np.diag([1, 1, -1]), np.full((3, 3), np.inf), np.ones((3, 3))])
    precision = [7.0, 5.0, np.nan, np.nan]
    graph = ViewGraph.create([0] * 4, [1] * 4, [_UNIT] * 4, information=stated, precision=precision)
    assert graph.information is not None
    assert graph.information[0].tolist() == np.diag([1.0, 2.0, 4.0]).tolist()
    assert bool(graph.information[1:].isnan().all())
    np.testing.assert_array_equal(graph.precision.numpy(), precision)
    implied = ViewGraph.create([0] * 4, [1] * 4, [_UNIT] * 4, information=stated).precision
    np.testing.assert_allclose(implied.numpy(), [3 / (1 + 1 / 2 + 1 / 4), np.nan, np.nan, np.nan])
    with pytest.raises(ViewGraphError, match=r"information has shape \(4, 6\); it must be \(1, 3, 3\)"):
        ViewGraph.create([0], [1], [_UNIT], information=np.ones((4, 6)))


@given(st.integers(0, 2**16))
def test_reversed_edges_state_the_same(seed: int) -> None:
    """Twice reversed is as it was; a small error's squared length in units of information is the same either way."""
    rng = np.random.default_rng(seed)
    error = Rotation.from_rotvec(1e-5 * rng.standard_normal((6, 3)))
    true = Rotation.random(6, random_state=seed)
    factors = rng.standard_normal((6, 3, 3))
    information = factors @ factors.transpose(0, 2, 1) + 0.1 * np.eye(3)
    place = rng.standard_normal((6, 3))
    measured = (error * true).as_quat()
    graph = ViewGraph.create([0] * 6, [1] * 6, measured, information=information, translation=place)
    some = torch.from_numpy(rng.random(6) < 0.5)
    other = graph.reverse_edges(some)
    again = other.reverse_edges(some)
    for name in ("source", "target", "target_from_source", "information", "translation"):
        torch.testing.assert_close(getattr(again, name), getattr(graph, name))
    reversed_ones = some.numpy()
    stated = Rotation.from_quat(other.target_from_source.numpy())
    wanted = Rotation.from_quat(np.where(reversed_ones[:, None], true.inv().as_quat(), true.as_quat()))
    noise = (stated * wanted.inv()).as_rotvec()
    assert other.information is not None and other.translation is not None
    lengths = np.einsum("mi,mij,mj->m", noise, other.information.numpy(), noise)
    expected = np.einsum("mi,mij,mj->m", error.as_rotvec(), information, error.as_rotvec())
    np.testing.assert_allclose(lengths, expected, rtol=1e-3)
    # The two bodies' places in each other's frames belong to one segment.
    np.testing.assert_allclose(np.linalg.norm(other.translation.numpy(), axis=1), np.linalg.norm(place, axis=1))
    assert other.source.tolist() == reversed_ones.astype(int).tolist()
