"""Chains that closures join: cuts of fewest runs, against all ways to part the chains; groups of most runs."""

from __future__ import annotations

import tracemalloc
from itertools import product

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.solver.slam.graph.chain_cuts import ChainCuts, connected, joined_by_others, with_most_runs


@given(st.integers(2, 6), st.integers(0, 14), st.integers(0, 2**32 - 1))
def test_a_cut_is_of_fewest_runs_and_as_near_as_there_is_one(count: int, joins: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = np.array([rng.permutation(count)[:2] for _ in range(joins)], dtype=np.int64).reshape(-1, 2)
    run = rng.integers(0, 4, joins)
    first, second = rng.permutation(count)[:2].tolist()

    def runs_across(is_beyond: np.ndarray) -> int:
        across = is_beyond[ends[:, 0]] != is_beyond[ends[:, 1]]
        return len({(*sorted(pair), number) for *pair, number in np.column_stack((ends, run))[across].tolist()})

    ways = [np.array(way) for way in product([False, True], repeat=count) if way[second] and not way[first]]
    fewest = min(map(runs_across, ways))
    sizes = [int(way.sum()) for way in ways if runs_across(way) == fewest]
    near_first, near_second = ChainCuts.of(count, ends, run).beyond(first, second)
    for is_beyond in (near_first, near_second):
        assert is_beyond[second] and not is_beyond[first]
        assert runs_across(is_beyond) == fewest
    assert near_first.sum() == max(sizes) and near_second.sum() == min(sizes)


@given(st.integers(2, 7), st.integers(0, 14), st.integers(0, 2**32 - 1))
def test_what_others_join_is_still_connected_without_it(count: int, joins: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    ends = np.array([rng.permutation(count)[:2] for _ in range(joins)], dtype=np.int64).reshape(-1, 2)
    joined = joined_by_others(count, ends)
    assert len(joined) == joins
    for one, (first, second) in enumerate(ends):
        component = connected(count, np.delete(ends, one, axis=0))
        assert joined[one] == (component[first] == component[second])


def test_runs_count_before_closures() -> None:
    run = np.array([0, 0, 0, 1, 2, 2])
    agree = np.array([[1, 1, 1, 0, 0, 0], [0, 0, 0, 1, 1, 0], [0, 0, 0, 1, 1, 1]], dtype=bool)
    assert with_most_runs(agree, run) == 2
    assert with_most_runs(agree[:2], run) == 1
    assert with_most_runs(agree[::-1] & False, run) == 0


@given(st.integers(1, 8), st.integers(1, 12), st.integers(0, 2**32 - 1))
def test_the_group_of_most_runs_is_that_of_sets(groups: int, closures: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    agree, run = rng.random((groups, closures)) < 0.5, rng.integers(0, 5, closures)
    counted = [(len(set(run[row].tolist())), int(row.sum())) for row in agree]
    assert counted[with_most_runs(agree, run)] == max(counted)


def test_many_closures_of_as_many_runs_take_little_memory() -> None:
    count = 20_000
    agree = np.eye(64, count, dtype=bool)
    agree[7] = True
    tracemalloc.start()
    try:
        assert with_most_runs(agree, np.arange(count)[::-1]) == 7
        assert tracemalloc.get_traced_memory()[1] < 5 * agree.nbytes
    finally:
        tracemalloc.stop()
