"""Forests as pointers to parents, beside walks that go step by step."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.solver.algebra.pointer_jumping import follow, lowest_common_ancestors, sums_of_branches


def _way_up(parent: np.ndarray, node: int) -> list[int]:
    """A node, its parent, and so on up to the root."""
    way = [node]
    while parent[way[-1]] != way[-1]:
        way.append(int(parent[way[-1]]))
    return way


def _levels(parent: np.ndarray) -> np.ndarray:
    return np.array([len(_way_up(parent, node)) - 1 for node in range(len(parent))])


@st.composite
def forests(draw: st.DrawFn) -> np.ndarray:
    """Parents of up to 40 nodes, numbered in any order; some are roots."""
    nodes = draw(st.integers(1, 40))
    above = [draw(st.integers(max(0, node - draw(st.integers(1, 40))), node)) for node in range(nodes)]
    name = np.array(draw(st.permutations(range(nodes))))
    parent = np.empty(nodes, dtype=np.int64)
    parent[name] = name[above]
    return parent


@given(forests())
def test_roots(parent: np.ndarray) -> None:
    assert follow(parent).tolist() == [_way_up(parent, node)[-1] for node in range(len(parent))]


@given(forests(), st.integers(0, 2**32 - 1))
def test_a_branch_is_a_node_and_all_below_it(parent: np.ndarray, seed: int) -> None:
    value = np.random.default_rng(seed).integers(-5, 6, len(parent)).astype(float)
    expected = np.zeros(len(parent))
    for node in range(len(parent)):
        for above in _way_up(parent, node):
            expected[above] += value[node]
    assert sums_of_branches(parent, _levels(parent), value).tolist() == expected.tolist()


@given(forests())
def test_ways_meet_at_the_lowest_common_ancestor(parent: np.ndarray) -> None:
    root = follow(parent)
    a, b = np.nonzero(root[:, None] == root)
    for one, other, found in zip(a, b, lowest_common_ancestors(parent, _levels(parent), a, b), strict=True):
        above = set(_way_up(parent, int(one)))
        assert found == next(node for node in _way_up(parent, int(other)) if node in above)
