"""What one Gaussian stands for a mixture of variances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from rotavg_ros.solver.slam.posterior.densities import Sites, log_good, log_normal


@pytest.mark.parametrize(("predicted", "told"), [(1e-9, "all"), (1e9, "nothing")])
def test_a_site_is_the_mean_precision_where_all_is_told_and_the_mean_variance_where_nothing_is(
    predicted: float, told: str
) -> None:
    variance, ratio, share = np.array([0.5, 2.0]), 16.0, 0.1
    site = Sites.of(np.zeros(2), variance, np.full(2, predicted), 3, np.full(2, share), ratio)
    exact = log_good(np.zeros(2), variance, np.full(2, predicted), 3, np.full(2, share), ratio)[1]
    mean_precision = (exact + (1 - exact) / ratio) / variance
    mean_variance = (exact + (1 - exact) * ratio) * variance
    np.testing.assert_allclose(site.weight, mean_precision if told == "all" else 1 / mean_variance, rtol=1e-6)


@given(st.floats(0.0, 9.0), st.floats(1e-6, 1.0), st.floats(0.0, 10.0), st.sampled_from([1, 3]), st.floats(0.0, 0.99))
def test_a_site_gives_a_residual_the_mean_that_its_mixture_has(
    square: float, variance: float, predicted: float, components: int, share: float
) -> None:
    """Against Bayes' rule for each variance by itself."""
    one = np.ones(1)
    site = Sites.of(square * one, variance * one, predicted * one, components, share * one, 16.0)
    variances = np.array([variance, 16.0 * variance])
    with np.errstate(divide="ignore"):
        log_chance = np.log([1 - share, share]) + log_normal(square, variances + predicted, components)
    chance = np.exp(log_chance - logsumexp(log_chance))
    expected = (chance * variances / (variances + predicted)).sum()
    assert 1 / (1 + site.weight[0] * predicted) == pytest.approx(expected, rel=1e-6)
    assert 1 / (16 * variance) * (1 - 1e-9) <= site.weight[0] <= 1 / variance * (1 + 1e-9)
