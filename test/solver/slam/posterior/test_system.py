"""The sparse system of the posterior."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.solver.algebra.sparse.laplacian import root_stiffness
from rotavg_ros.solver.slam.posterior.system import NormalEquations

LENGTH, CLOSURES = 400, 600


def equations() -> NormalEquations:
    """A chain, and closures from its first half to its second, two of which share an error."""
    rng = np.random.default_rng(0)
    source = np.concatenate((np.arange(LENGTH - 1), rng.integers(0, LENGTH // 2, CLOSURES)))
    target = np.concatenate((np.arange(1, LENGTH), rng.integers(LENGTH // 2, LENGTH, CLOSURES)))
    run = np.full(len(source), -1)
    run[LENGTH - 1 : LENGTH + 1] = 0
    return NormalEquations(LENGTH, source, target, run, np.where(run >= 0, 1.0, 0.0), roots=np.zeros(1, dtype=int))


def weights() -> np.ndarray:
    """Five in six closures weigh nothing."""
    weight = np.random.default_rng(1).uniform(1e2, 1e4, LENGTH + CLOSURES)
    weight[LENGTH + 50 : LENGTH + 550] *= 1e-14
    return weight


def test_rows_that_weigh_nothing_are_left_out_of_the_factor_and_change_nothing() -> None:
    """Many false closures fill the factor; without them steps, determinants and leverages are the same."""
    system, weight = equations(), weights()
    jacobian = system.rows.toarray()
    grounded = (jacobian.T * weight) @ jacobian
    grounded[0, 0] += root_stiffness(weight)
    inverse, log_det = np.linalg.inv(grounded), np.linalg.slogdet(grounded)[1] - np.log(root_stiffness(weight))
    difference = np.random.default_rng(2).normal(size=(LENGTH + CLOSURES, 3))
    found = system.factorise(weight)
    assert found.num_entries < 0.6 * system.factorise(np.ones(len(weight))).num_entries
    np.testing.assert_allclose(found.fit(difference), inverse @ (jacobian.T * weight) @ difference, atol=1e-8)
    assert found.log_det == pytest.approx(log_det, abs=1e-6)
    covariance = jacobian @ inverse @ jacobian.T
    np.testing.assert_allclose(found.resistance, np.diag(covariance), rtol=1e-4)
    np.testing.assert_allclose(found.variance, np.diag(inverse), rtol=1e-6, atol=1e-12)
    rows = np.array([3, LENGTH, LENGTH + 100])
    np.testing.assert_allclose(found.covariance(rows), covariance[np.ix_(rows, rows)], rtol=1e-6, atol=1e-12)
    kept = found.resistance_of_kept
    assert np.isnan(kept[LENGTH + 50 : LENGTH + 550]).all()
    np.testing.assert_array_equal(np.isnan(kept) | (kept == found.resistance), True)


def test_what_one_edge_alone_decides_counts_as_nearly_all() -> None:
    """Of a step that nothing else spans the leverage is one, and what is left of it stays positive."""
    weight = weights()
    weight[LENGTH - 1 : LENGTH - 1 + CLOSURES] = 1e-12
    leverage = weight * equations().factorise(weight).resistance
    assert (leverage[: LENGTH - 1] < 1 - 0.9e-6).all()
    np.testing.assert_allclose(leverage[: LENGTH - 1], 1.0, atol=1e-5)


def test_what_alone_holds_the_graph_together_stays_in_however_little_it_weighs() -> None:
    weight = weights()
    weight[100] *= 1e-14
    weight[LENGTH - 1 : LENGTH - 1 + CLOSURES] = 1e-10
    fit = equations().factorise(weight).fit(np.ones((len(weight), 3)))
    assert np.isfinite(fit).all()
    # Of the broken step: all that is left of it is in the closures across.
    assert np.abs(fit[:100]).max() < 200
