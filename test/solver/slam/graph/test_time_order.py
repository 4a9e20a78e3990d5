"""Which way odometry runs follows from the path itself, whatever its keyframes are called."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.solver.slam.graph.odometry_paths import odometry_ends, runs_forward
from rotavg_ros.view_graph import EdgeKind, ViewGraph


def paths(lengths: list[int], rng: np.random.Generator, is_renumbered: bool) -> tuple[ViewGraph, np.ndarray]:
    """Of robots one after the other, with closures; edges in any direction and order. And each node's place in time.

    Of the ends of a path the one of the lower number is its beginning.
    """
    count = sum(lengths)
    number = rng.permutation(count) if is_renumbered else np.arange(count)
    ends = np.cumsum(lengths)
    for first, last in zip(ends - lengths, ends - 1, strict=True):
        number[[first, last]] = np.sort(number[[first, last]])
    steps = np.setdiff1d(np.arange(count - 1), ends - 1)
    closures = rng.integers(0, count, (5, 2))
    closures = closures[closures[:, 0] != closures[:, 1]]
    edges = np.concatenate((np.stack((steps, steps + 1), axis=1), closures))
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [len(steps), len(closures)])
    swapped = rng.random(len(edges)) < 0.5
    edges[swapped] = edges[swapped, ::-1]
    order = rng.permutation(len(edges))
    time = np.empty(count, dtype=np.int64)
    time[number] = np.arange(count)
    identity = np.tile([0.0, 0.0, 0.0, 1.0], (len(edges), 1))
    source, target = number[edges[order]].T
    return ViewGraph.create(source, target, identity, num_nodes=count, kind=kind[order]), time


@given(st.lists(st.integers(1, 8), min_size=1, max_size=3), st.integers(0, 2**32), st.booleans())
def test_odometry_runs_from_the_older_to_the_newer_end(lengths, seed, is_renumbered):
    graph, time = paths(lengths, np.random.default_rng(seed), is_renumbered)
    source, target = graph.source.numpy(), graph.target.numpy()
    expected = np.where(graph.is_odometry.numpy(), time[source] < time[target], source < target)
    np.testing.assert_array_equal(runs_forward(graph), expected)


@given(st.lists(st.integers(1, 8), min_size=1, max_size=3), st.integers(0, 2**32))
def test_trees_hang_from_where_paths_begin_or_end(lengths, seed):
    graph, time = paths(lengths, np.random.default_rng(seed), True)
    last = np.cumsum(lengths)
    np.testing.assert_array_equal(
        np.sort(time[odometry_ends(graph)]), np.unique(np.concatenate((last - lengths, last - 1)))
    )
