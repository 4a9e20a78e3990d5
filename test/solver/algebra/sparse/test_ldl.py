"""L D Lᵀ and what it says of rows, against dense algebra."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rotavg_ros.solver.algebra.sparse import ldl
from rotavg_ros.solver.algebra.sparse.ldl import RowPattern
from rotavg_ros.solver.algebra.sparse.ldl_loops import _merge_in
from rotavg_ros.solver.running.work import metered


def rows(rng: np.random.Generator, size: int, count: int) -> tuple[np.ndarray, np.ndarray]:
    """A chain, and rows between any of its nodes, some with a third unknown, some with one alone."""
    chain = np.stack((np.arange(1, size), np.arange(size - 1), np.arange(1, size)), axis=1)
    any_two = np.array([rng.permutation(size)[:3] for _ in range(count)], dtype=np.int64).reshape(-1, 3)
    column = np.concatenate((chain, any_two))
    value = np.tile([1.0, -1.0, 0.0], (len(column), 1))
    value[len(chain) :, 2] = rng.choice([0.0, 1.0, -1.0], count)
    value[len(chain) :: 5, 1] = 0.0
    return column, value


def dense(column: np.ndarray, value: np.ndarray, size: int) -> np.ndarray:
    """J."""
    jacobian = np.zeros((len(column), size))
    np.add.at(jacobian, (np.arange(len(column))[:, None], column), value)
    return jacobian


@given(st.integers(0, 10_000), st.integers(3, 40), st.integers(0, 60), st.sampled_from([2, 10, 100]))
def test_all_of_it_is_that_of_dense_algebra(seed: int, size: int, count: int, many: int) -> None:
    """Whether or not its last columns, where they are full, are a dense factor."""
    rng = np.random.default_rng(seed)
    column, value = rows(rng, size, count)
    weight, extra = rng.uniform(0.1, 100.0, len(column)), np.zeros(size)
    extra[rng.integers(size)] = 1e3
    jacobian = dense(column, value, size)
    matrix = (jacobian.T * weight) @ jacobian + np.diag(extra)
    inverse = np.linalg.inv(matrix)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ldl, "_MANY", many)
        pattern = RowPattern(column, value, size)
    factor = pattern.factorise(weight, extra)
    assert factor.log_det == pytest.approx(np.linalg.slogdet(matrix)[1], rel=1e-9, abs=1e-9)
    right = rng.normal(size=(size, 3))
    np.testing.assert_allclose(factor.solve(right), inverse @ right, rtol=1e-6, atol=1e-9)
    np.testing.assert_allclose(factor.variance, np.diag(inverse), rtol=1e-6)
    np.testing.assert_allclose(factor.row_variance, np.einsum("ei,ij,ej->e", jacobian, inverse, jacobian), rtol=1e-6)
    # Few rows go up the tree each, of many each unknown does.
    for count in (20, 300):
        others, factors = rows(rng, size, count)
        far = dense(others, factors, size)
        expected = np.einsum("ei,ij,ej->e", far, inverse, far)
        np.testing.assert_allclose(factor.variance_of(others, factors), expected, rtol=1e-6, atol=1e-12)


def test_what_many_rows_are_told_costs_no_more_than_their_unknowns() -> None:
    """By their ends or each by itself they come out alike, to rounding."""
    rng, size = np.random.default_rng(3), 300
    column, value = rows(rng, size, 200)
    factor = RowPattern(column, value, size).factorise(rng.uniform(0.1, 100.0, len(column)), np.full(size, 0.01))
    others, factors = rows(rng, size, 5000)
    with metered() as by_ends:
        found = factor.variance_of(others, factors)
    with pytest.MonkeyPatch.context() as patch, metered() as each:
        patch.setattr(ldl, "_NUMBERS", 0.0)
        np.testing.assert_allclose(factor.variance_of(others, factors), found, rtol=1e-11)
    assert by_ends.spent < 0.1 * each.spent


@given(st.integers(0, 10_000), st.integers(3, 40), st.integers(0, 60))
def test_the_order_of_elimination_changes_nothing(seed: int, size: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    column, value = rows(rng, size, count)
    weight, extra = rng.uniform(0.1, 100.0, len(column)), np.full(size, 0.1)
    found = RowPattern(column, value, size).factorise(weight, extra)
    otherwise = RowPattern(column, value, size, rng.permutation(size)).factorise(weight, extra)
    assert found.log_det == pytest.approx(otherwise.log_det, rel=1e-9)
    np.testing.assert_allclose(found.row_variance, otherwise.row_variance, rtol=1e-8)
    right = rng.normal(size=(size, 2))
    np.testing.assert_allclose(found.solve(right), otherwise.solve(right), rtol=1e-8, atol=1e-12)


def test_rows_between_the_same_unknowns_add_up() -> None:
    column, value = np.array([[1, 0, 1], [0, 1, 0], [1, 0, 1]]), np.tile([1.0, -1.0, 0.0], (3, 1))
    factor = RowPattern(column, value, 2).factorise(np.array([1.0, 2.0, 3.0]), np.array([1e6, 0.0]))
    np.testing.assert_allclose(factor.row_variance, 1 / 6, rtol=1e-9)


def test_the_factor_of_a_chain_has_no_fill() -> None:
    column, value = rows(np.random.default_rng(0), 500, 0)
    pattern = RowPattern(column, value, 500)
    assert (pattern.num_entries, pattern.num_factor_entries) == (500 + 499, 499)


@pytest.mark.parametrize("many", [2, 100])
def test_what_rounding_leaves_no_pivot_stays_positive(many: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ldl, "_MANY", many)
    column, value = rows(np.random.default_rng(0), 50, 0)
    factor = RowPattern(column, value, 50).factorise(np.full(49, 1e16), np.append(1e-3, np.zeros(49)))
    assert (factor.diagonal > 0).all()
    assert np.isfinite(factor.solve(np.ones((50, 1)))).all()


@pytest.mark.parametrize(("known", "new"), [(0, 0), (0, 3), (3, 0), (1, 7), (20, 30)])
def test_paths_are_merged_in_order(known: int, new: int) -> None:
    numbers = np.random.default_rng(known).permutation(100)[: known + new]
    way, path = np.append(np.sort(numbers[:known]), np.zeros(new, dtype=np.int64)), np.sort(numbers[known:])
    _merge_in(path, way)
    np.testing.assert_array_equal(way, np.sort(numbers))
