"""Cholesky by fronts, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.solver.algebra.sparse import merging
from rotavg_ros.solver.algebra.sparse.elimination import Elimination
from rotavg_ros.solver.algebra.sparse.multifrontal import Cholesky
from rotavg_ros.solver.running.work import metered, resting


def _graph(rng: np.random.Generator, blocks: int, ties: int) -> tuple[np.ndarray, np.ndarray]:
    """Some ties among some blocks: others are tied to nothing, some ties come twice or lead nowhere."""
    first, second = rng.integers(0, max(1, blocks - 2), (2, ties))
    return np.concatenate((first, second[:3])), np.concatenate((second, first[:3]))


def _matrix(rng: np.random.Generator, first: np.ndarray, second: np.ndarray, blocks: int, size: int) -> np.ndarray:
    """``(B, d, B, d)``, positive definite."""
    matrix = np.zeros((blocks, size, blocks, size))
    matrix[np.arange(blocks), :, np.arange(blocks)] = 0.1 * np.eye(size)
    for one, other in zip(first, second, strict=True):
        rows = dict(zip((one, other), rng.normal(size=(2, size, size)), strict=True))
        for above, part in rows.items():
            for below, its_part in rows.items():
                matrix[above, :, below] += part.T @ its_part
    return matrix


def _elimination(first: np.ndarray, second: np.ndarray, blocks: int, size: int, *, is_dense: bool) -> Elimination:
    """With fronts as small as they come, or held to be large, each of them."""
    with pytest.MonkeyPatch.context() as patch:
        if is_dense:
            patch.setattr(merging, "DENSE", -1.0)
        elimination = Elimination(first, second, blocks, size)
    assert all(stretch.is_dense == is_dense for stretch in elimination.stretches)
    return elimination


def _upper(elimination: Elimination, matrix: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Blocks that are tied, the one that is eliminated first before the other."""
    one, other = np.nonzero(np.abs(matrix).sum(axis=(1, 3)))
    is_above = elimination.rank[one] <= elimination.rank[other]
    return one[is_above], other[is_above]


def _entries(elimination: Elimination, matrix: np.ndarray) -> np.ndarray:
    entries = np.zeros(elimination.num_entries)
    one, other = _upper(elimination, matrix)
    entries[elimination.places(elimination.rank[one], elimination.rank[other])] = matrix[one, :, other]
    return entries


def _solved(elimination: Elimination, matrix: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``(B, d, n)``."""
    blocks, size = matrix.shape[:2]
    ordered = np.empty_like(right)
    ordered[elimination.rank] = right
    solution = Cholesky(elimination, _entries(elimination, matrix)).solve(ordered.reshape(blocks * size, -1))
    return solution.reshape(right.shape)[elimination.rank]


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**32 - 1), st.integers(1, 60), st.integers(0, 120), st.sampled_from([1, 3, 6]), st.booleans())
def test_it_solves_what_dense_algebra_does(seed: int, blocks: int, ties: int, size: int, is_dense: bool) -> None:
    rng = np.random.default_rng(seed)
    first, second = _graph(rng, blocks, ties)
    matrix = _matrix(rng, first, second, blocks, size)
    elimination = _elimination(first, second, blocks, size, is_dense=is_dense)
    assert sorted(elimination.rank) == list(range(blocks))
    right = rng.normal(size=(blocks, size, 5))
    flat = matrix.reshape(blocks * size, -1)
    expected = np.linalg.solve(flat, right.reshape(blocks * size, 5)).reshape(right.shape)
    np.testing.assert_allclose(_solved(elimination, matrix, right), expected, rtol=1e-7, atol=1e-7)
    factor = Cholesky(elimination, _entries(elimination, matrix))
    assert factor.log_det == pytest.approx(np.linalg.slogdet(flat)[1], abs=1e-7)
    inverse = np.linalg.inv(flat).reshape(matrix.shape)
    one, other = _upper(elimination, matrix)
    found = factor.inverse[elimination.places(elimination.rank[one], elimination.rank[other])]
    np.testing.assert_allclose(np.triu(found), np.triu(inverse[one, :, other]), rtol=1e-6, atol=1e-7)
    is_between = one != other
    np.testing.assert_allclose(found[is_between], inverse[one, :, other][is_between], rtol=1e-6, atol=1e-7)


def test_neither_the_order_nor_the_direction_of_ties_matters() -> None:
    rng = np.random.default_rng(0)
    first, second = _graph(rng, 200, 260)
    order = rng.permutation(len(first))
    turned = rng.random(len(first)) < 0.5
    one = np.where(turned, second, first)[order], np.where(turned, first, second)[order]
    before, after = Elimination(first, second, 200, 3), Elimination(*one, 200, 3)
    np.testing.assert_array_equal(after.rank, before.rank)
    assert after.num_entries == before.num_entries


def test_a_chain_is_eliminated_in_few_fronts_and_little_room() -> None:
    def chain(blocks: int) -> Elimination:
        return Elimination(np.arange(blocks - 1), np.arange(1, blocks), blocks, 3)

    short, long = chain(1000), chain(4000)
    assert len(long.shape.begin) < 2000
    assert 3 * short.num_entries < long.num_entries < 5 * short.num_entries


def test_fill_that_lies_far_apart_has_its_place() -> None:
    """Eliminated from one end of a long ladder, what ties its ends is thousands of products of shares."""
    blocks = 3000
    rung = np.arange(0, blocks - 3, 2)
    first = np.concatenate((rung, rung + 1, rung, [0]))
    second = np.concatenate((rung + 2, rung + 3, rung + 1, [blocks - 1]))
    elimination = Elimination(first, second, blocks, 1)
    rng = np.random.default_rng(1)
    weight = np.exp(rng.normal(size=len(first)))
    diagonal = np.bincount(first, weight, blocks) + np.bincount(second, weight, blocks) + 1e-3
    rank, entries = elimination.rank, np.zeros(elimination.num_entries)
    lower, upper = np.minimum(rank[first], rank[second]), np.maximum(rank[first], rank[second])
    np.add.at(entries, elimination.places(lower, upper)[:, 0, 0], -weight)
    entries[elimination.places(rank, rank)[:, 0, 0]] += diagonal
    truth = rng.normal(size=blocks)
    right = diagonal * truth
    np.add.at(right, first, -weight * truth[second])
    np.add.at(right, second, -weight * truth[first])
    ordered = np.empty((blocks, 1))
    ordered[rank, 0] = right
    np.testing.assert_allclose(Cholesky(elimination, entries).solve(ordered)[rank, 0], truth, atol=1e-7)


def test_what_asks_little_is_answered_alike() -> None:
    """Fronts below which a right-hand side has nothing are passed over."""
    rng = np.random.default_rng(2)
    first, second = _graph(rng, 150, 200)
    matrix = _matrix(rng, first, second, 150, 3)
    right = np.zeros((150, 3, 1))
    right[7] = 1.0
    expected = np.linalg.solve(matrix.reshape(450, 450), right.reshape(450, 1)).reshape(right.shape)
    np.testing.assert_allclose(_solved(Elimination(first, second, 150, 3), matrix, right), expected, atol=1e-8)


def test_it_can_be_left_between_fronts_and_its_work_is_counted() -> None:
    rng = np.random.default_rng(3)
    first, second = _graph(rng, 900, 1350)
    elimination = Elimination(first, second, 900, 3)
    entries = _entries(elimination, _matrix(rng, first, second, 900, 3))
    left = []
    with metered() as meter, resting(left.append):
        rested = Cholesky(elimination, entries.copy())
    assert len(left) == len(elimination.stretches) > 3
    assert {stretch.is_dense for stretch in elimination.stretches} == {False, True}
    assert meter.spent == pytest.approx(elimination.units) == pytest.approx(sum(left))
    right = rng.normal(size=(2700, 1))
    np.testing.assert_array_equal(rested.solve(right), Cholesky(elimination, entries).solve(right))
    # What it is said to cost is spent where it is done, none of it before.
    told: list[float] = []
    with resting(told.append):
        rested.solve(right, 100.0)
    assert sum(told) == pytest.approx(100.0)
    assert len(told) == 2 * len(elimination.stretches)
    assert told[0] == pytest.approx(50.0 * elimination.stretches[0].units / elimination.units)


def test_a_front_that_rounding_leaves_no_pivot_is_lifted() -> None:
    first, second = np.array([0, 1]), np.array([1, 2])
    elimination = Elimination(first, second, 3, 1)
    # A Laplacian that nothing holds.
    matrix = np.array([[1.0, -1.0, 0.0], [-1.0, 2.0, -1.0], [0.0, -1.0, 1.0]]).reshape(3, 1, 3, 1)
    assert np.isfinite(_solved(elimination, matrix, np.ones((3, 1, 1)))).all()


@pytest.mark.parametrize("scale", [1.0, 1e-9, 1e12])
def test_a_large_part_that_nothing_holds_is_lifted_as_well(scale: float) -> None:
    """What earlier pivots leave of the last one may be less than nothing."""
    blocks = 23
    first, second = np.triu_indices(blocks, 1)
    rng = np.random.default_rng(0)
    for _ in range(20):
        weight = scale * np.exp(5 * rng.normal(size=len(first)))
        matrix = np.zeros((blocks, blocks))
        np.add.at(matrix, (first, second), -weight)
        matrix += matrix.T
        matrix -= np.diag(matrix.sum(axis=1))
        elimination = Elimination(first, second, blocks, 1)
        solved = _solved(elimination, matrix.reshape(blocks, 1, blocks, 1), np.ones((blocks, 1, 1)))
        assert np.isfinite(solved).all()


def test_what_rounding_leaves_of_many_pivots_does_not_grow() -> None:
    """Of a matrix of a third of its full rank: what is left beside a pivot is rounding as well as the pivot."""
    blocks, size = 8, 6
    first, second = np.triu_indices(blocks, 1)
    elimination = _elimination(first, second, blocks, size, is_dense=False)
    for seed in range(20):
        rng = np.random.default_rng(seed)
        root = np.exp(4 * rng.normal(size=(blocks * size, 1))) * rng.normal(size=(blocks * size, blocks * size // 3))
        matrix = (root @ root.T).reshape(blocks, size, blocks, size)
        known = rng.normal(size=(blocks * size // 3, 1))
        solved = _solved(elimination, matrix, (root @ known).reshape(blocks, size, 1))
        # One of the solutions, as far as the scales of its equations let tell.
        np.testing.assert_allclose(root.T @ solved.reshape(-1, 1), known, rtol=0, atol=0.01)


@pytest.mark.parametrize("value", [-1.0, np.nan])
def test_what_is_not_positive_definite_is_refused(value: float) -> None:
    elimination = Elimination(np.array([0]), np.array([1]), 2, 1)
    with pytest.raises(RuntimeError, match="positive definite"):
        Cholesky(elimination, np.full(elimination.num_entries, value))
