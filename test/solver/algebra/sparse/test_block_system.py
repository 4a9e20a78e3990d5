"""The joint system against dense algebra, where many rows weigh next to nothing."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.algebra.sparse import block_system
from rotavg_ros.solver.algebra.sparse.block_system import BlockEquations

_SIZE = (1, 2)
_D = sum(_SIZE)
_NODES = 80


def _ends(rng: np.random.Generator, closures: int) -> np.ndarray:
    chain = np.stack((np.arange(_NODES - 1), np.arange(1, _NODES)), axis=1)
    first = rng.integers(0, _NODES - 1, closures)
    return np.concatenate((chain, np.stack((first, (first + rng.integers(1, _NODES - 1, closures)) % _NODES), axis=1)))


def _jacobian(rng: np.random.Generator, ends: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """Whitened rows ``(E, d, 3 d)``: a target's block, a source's that turns it, and no run."""
    lever = np.tile(-np.eye(_D), (len(ends), 1, 1))
    lever[:, 1:, :1] = rng.normal(size=(len(ends), 2, 1))
    rows = np.concatenate((np.tile(np.eye(_D), (len(ends), 1, 1)), lever, np.zeros((len(ends), _D, _D))), axis=2)
    return np.sqrt(weight)[:, None, None] * rows


def _dense(ends: np.ndarray, jacobian: np.ndarray) -> np.ndarray:
    rows = np.zeros((len(ends), _D, _NODES, _D))
    edge = np.arange(len(ends))
    rows[edge, :, ends[:, 1]] += jacobian[:, :, :_D]
    rows[edge, :, ends[:, 0]] += jacobian[:, :, _D : 2 * _D]
    return rows.reshape(len(ends) * _D, _NODES * _D)


@pytest.mark.parametrize("false", [0, 150, 600])
def test_fits_as_dense_algebra_does_however_many_rows_weigh_nothing(false: int) -> None:
    rng = np.random.default_rng(false)
    ends = _ends(rng, 40 + false)
    weight = np.concatenate((np.full(_NODES - 1, 100.0), np.full(40, 1.0), np.full(false, 1e-10)))
    jacobian, roots = _jacobian(rng, ends, weight), np.array([0])
    root_weight = np.full(_D, 1e3)
    measured = rng.normal(size=(len(ends), _D, 2)) * np.sqrt(weight)[:, None, None]
    equations = BlockEquations(_SIZE, _NODES, ends, np.full(len(ends), -1), roots, np.empty(0, dtype=np.int64))
    factor = equations.factorise(jacobian, root_weight)
    rows = _dense(ends, jacobian)
    information = rows.T @ rows
    information[:_D, :_D] += np.diag(root_weight)
    expected = np.linalg.solve(information, rows.T @ measured.reshape(-1, 2)).reshape(_NODES, _D, 2)
    np.testing.assert_allclose(factor.fit(measured), expected, rtol=1e-4, atol=1e-6)
    expected_log_det = np.linalg.slogdet(information)[1] - np.log(root_weight).sum()
    assert factor.log_det == pytest.approx(expected_log_det, abs=1e-5)
    inverse = np.linalg.inv(information)
    of_rows = rows.reshape(len(ends), _D, -1)
    leverage = of_rows @ inverse @ of_rows.transpose(0, 2, 1)
    pulls = weight > 1e-3
    np.testing.assert_allclose(factor.leverage[pulls], leverage[pulls], atol=1e-6)
    np.testing.assert_allclose(factor.variance.ravel(), np.diag(inverse), rtol=1e-5)
    # What everything else says of a row that pulls nothing is told nevertheless, from samples where there are many.
    if false:
        told = np.trace(factor.leverage[~pulls], axis1=1, axis2=2) / np.trace(leverage[~pulls], axis1=1, axis2=2)
        assert abs(np.log(told)).mean() < (0.3 if false > 200 else 1e-4)
    np.testing.assert_allclose(factor.predicted(expected), (rows @ expected.reshape(-1, 2)).reshape(-1, _D, 2))


def test_rows_that_weigh_nothing_fill_no_factor() -> None:
    rng = np.random.default_rng(1)
    ends = _ends(rng, 640)
    nowhere = np.empty(0, dtype=np.int64)
    equations = BlockEquations(_SIZE, _NODES, ends, np.full(len(ends), -1), np.array([0]), nowhere)
    weight = np.concatenate((np.full(_NODES - 1, 100.0), np.full(40, 1.0), np.full(600, 1.0)))
    jacobian = _jacobian(rng, ends, weight)
    everything = equations.factorise(jacobian, np.full(_D, 1e3)).num_entries
    jacobian[-600:] *= 1e-5
    assert equations.factorise(jacobian, np.full(_D, 1e3)).num_entries < everything / 2


def test_parts_that_only_such_rows_join_stay_solvable(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(block_system, "_WORTH_LEAVING_OUT", 1)
    rng = np.random.default_rng(2)
    half = _NODES // 2
    ends = _ends(rng, 0)
    ends = np.concatenate((np.delete(ends, half - 1, axis=0), [[3, half + 3], [5, half + 9]]))
    weight = np.concatenate((np.full(len(ends) - 2, 100.0), np.full(2, 1e-9)))
    nowhere = np.empty(0, dtype=np.int64)
    equations = BlockEquations(_SIZE, _NODES, ends, np.full(len(ends), -1), np.array([0]), nowhere)
    jacobian = _jacobian(rng, ends, weight)
    unknowns = rng.normal(size=(_NODES, _D, 1))
    unknowns[0] = 0.0
    rows = _dense(ends, jacobian)
    fitted = equations.factorise(jacobian, np.full(_D, 1e3)).fit((rows @ unknowns.reshape(-1, 1)).reshape(-1, _D, 1))
    np.testing.assert_allclose(fitted, unknowns, atol=1e-2)


@pytest.mark.parametrize("size", [(1, 2), (1, 3), (3, 3)])
def test_what_all_else_says_of_rows_that_share_errors_is_exact(size: tuple[int, int]) -> None:
    rng = np.random.default_rng(sum(size))
    k, d, edges = size[0], sum(size), 120
    source = np.append(np.arange(_NODES - 1), rng.integers(0, _NODES // 2, edges - _NODES + 1))
    target = np.append(np.arange(1, _NODES), rng.integers(_NODES // 2, _NODES, edges - _NODES + 1))
    run = np.full(edges, -1)
    run[-24:] = np.repeat(np.arange(4), 6)
    jacobian = np.zeros((edges + 4, d, 3 * d))
    jacobian[:, :, :d] = np.eye(d)
    jacobian[:edges, :, d : 2 * d] = -np.eye(d)
    jacobian[:edges, k:, d : d + k] = rng.normal(size=(edges, size[1], k))
    jacobian[:edges, :, 2 * d :] = ((run >= 0) * rng.choice([-1, 1], edges))[:, None, None] * np.eye(d)
    jacobian *= np.exp(rng.normal(size=(edges + 4, d, 1)))
    roots, nothing = np.array([0]), np.empty(0, dtype=np.int64)
    equations = BlockEquations(size, _NODES, np.stack((source, target), axis=1), run, roots, nothing)
    factor = equations.factorise(jacobian, np.full(d, 1e3))
    rows = np.zeros((edges + 4, d, _NODES + 4, d))
    for third in range(3):
        has = np.flatnonzero(equations.block[:, third] >= 0)
        rows[has, :, equations.block[has, third]] += jacobian[has, :, third * d : (third + 1) * d]
    flat = rows.reshape((edges + 4) * d, -1)
    information = flat.T @ flat
    information[:d, :d] += 1e3 * np.eye(d)
    covariance = (flat @ np.linalg.solve(information, flat.T)).reshape(edges + 4, d, edges + 4, d)
    each = np.arange(edges + 4)
    leverage = covariance[each, :, each]
    np.testing.assert_allclose(factor.leverage, leverage, atol=1e-6)
    others, said = factor.without(each)
    expected = np.linalg.inv(np.eye(d) - leverage)
    is_told = np.linalg.eigvalsh(leverage).max(axis=1) < 1 - 1e-6
    assert is_told.sum() > 50
    np.testing.assert_allclose(others[is_told], expected[is_told], rtol=1e-4, atol=1e-6)
    np.testing.assert_allclose(said[is_told], (expected @ leverage)[is_told], rtol=1e-4, atol=1e-6)
    chosen = np.array([edges - 1, 3, edges - 7, edges - 2])
    together = factor.covariance_between(jacobian[chosen], chosen)
    np.testing.assert_allclose(together, covariance[chosen][:, :, chosen].reshape(4 * d, 4 * d), atol=1e-6)
