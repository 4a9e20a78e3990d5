"""Conditional normal densities against NumPy's inverses."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from rotavg_ros.solver.slam.update.given import Given


@pytest.mark.parametrize("given", [[], [1, 4], range(6)])
def test_residuals_less_what_those_that_are_given_say(given: Sequence[int]) -> None:
    """Each against a normal density's conditional mean and covariance, the one itself left out of what is given."""
    rng = np.random.default_rng(0)
    count, d = 6, 3
    rows = rng.normal(size=(40, count * d))
    whole, residual = rows.T @ rows, rng.normal(size=(count, d, 1))
    is_given = np.isin(np.arange(count), given)
    covariance = whole.reshape(count, d, count, d)
    mean, left = Given.of(covariance, is_given).left_out(covariance, residual)
    for one in range(count):
        own = np.arange(one * d, one * d + d)
        told = np.flatnonzero(np.repeat(is_given & (np.arange(count) != one), d))
        gain = whole[np.ix_(own, told)] @ np.linalg.inv(whole[np.ix_(told, told)])
        np.testing.assert_allclose(mean[one, :, 0], (residual.ravel()[own] - gain @ residual.ravel()[told]), atol=1e-9)
        np.testing.assert_allclose(left[one], whole[np.ix_(own, own)] - gain @ whole[np.ix_(told, own)], atol=1e-9)


@pytest.mark.parametrize("d", [1, 3])
def test_one_subset_after_the_other_is_the_same_as_each_by_itself(d: int) -> None:
    """Closures come, and are believed or doubted, a few at a time; the inverses are those of NumPy."""
    rng = np.random.default_rng(1)
    most = 60
    rows = rng.normal(size=(2 * most * d, most * d))
    whole, told_of = rows.T @ rows, rng.normal(size=(7, most * d))
    given, told, changes_seen = Given.none(0, d), np.zeros(7), 0
    is_given = np.zeros(0, dtype=bool)
    for count in range(2, most + 1, 2):
        covariance = whole[: count * d, : count * d].reshape(count, d, count, d)
        is_given = np.append(is_given, rng.random(2) < 0.8)
        is_given[rng.integers(count)] ^= True
        given, changes = given.changed_to(covariance, is_given)
        covaries = np.ascontiguousarray(told_of[:, : count * d])
        if changes is None:
            told = given.told(covaries)
        else:
            told = told + sum(change.told(covaries) for change in changes)
            changes_seen += len(changes)
        row = np.flatnonzero(np.repeat(is_given, d))
        expected = np.zeros((count * d, count * d))
        expected[np.ix_(row, row)] = np.linalg.inv(whole[np.ix_(row, row)])
        np.testing.assert_allclose(given.precision, expected, atol=1e-10)
        np.testing.assert_allclose(told, np.einsum("ij,jk,ik->i", covaries, expected, covaries), atol=1e-9)
    assert changes_seen > 30
