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
