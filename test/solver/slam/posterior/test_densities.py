"""What one Gaussian stands for a mixture of variances."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import logsumexp

from rotavg_ros.solver.slam.posterior.densities import Sites, Tails, beyond, log_good, log_normal


@pytest.mark.parametrize(("predicted", "told"), [(1e-9, "all"), (1e9, "nothing")])
def test_a_site_is_the_mean_precision_where_all_is_told_and_the_mean_variance_where_nothing_is(
    predicted: float, told: str
) -> None:
    variance, ratio, share = np.array([0.5, 2.0]), 16.0, 0.1
    tails = Tails(np.full(2, share), np.full(2, ratio), np.ones(2))
    site = Sites.of(np.zeros(2), variance, np.full(2, predicted), 3, tails)
    exact = log_good(np.zeros(2), variance, np.full(2, predicted), 3, tails)[1]
    mean_precision = (exact + (1 - exact) / ratio) / variance
    mean_variance = (exact + (1 - exact) * ratio) * variance
    np.testing.assert_allclose(site.weight, mean_precision if told == "all" else 1 / mean_variance, rtol=1e-6)


@given(
    st.floats(0.0, 9.0),
    st.floats(1e-6, 1.0),
    st.floats(0.0, 10.0),
    st.sampled_from([1, 3]),
    st.tuples(st.floats(0.0, 0.99), st.sampled_from([16.0, 256.0])),
)
def test_a_site_gives_a_residual_the_mean_that_its_mixture_has(
    square: float, variance: float, predicted: float, components: int, tails: tuple[float, float]
) -> None:
    """Against Bayes' rule for each variance by itself."""
    one, (share, ratio) = np.ones(1), tails
    site = Sites.of(square * one, variance * one, predicted * one, components, Tails(share * one, ratio * one, one))
    variances = np.array([variance, ratio * variance])
    with np.errstate(divide="ignore"):
        log_chance = np.log([1 - share, share]) + log_normal(square, variances + predicted, components)
    chance = np.exp(log_chance - logsumexp(log_chance))
    expected = (chance * variances / (variances + predicted)).sum()
    assert 1 / (1 + site.weight[0] * predicted) == pytest.approx(expected, rel=1e-6)
    assert 1 / (ratio * variance) * (1 - 1e-9) <= site.weight[0] <= 1 / variance * (1 + 1e-9)


def test_noise_beyond_an_angle_is_counted_in_the_tails_as_well() -> None:
    """Others predict 12° ± 2° of an edge that may be in the tails: against the posterior on a grid."""
    variance, predicted, mean = np.radians(1.0) ** 2, np.radians(2.0) ** 2, np.radians(12.0)
    tails, angle = Tails(np.array([0.02]), np.array([256.0]), np.ones(1)), np.radians(10.0)
    noise = np.linspace(-1.0, 1.0, 200_001)
    log_own = np.logaddexp(
        np.log1p(-tails.share) + log_normal(noise**2, variance, 1),
        np.log(tails.share) + log_normal(noise**2, 256.0 * variance, 1),
    )
    chance = np.exp(log_own + log_normal((noise - mean) ** 2, predicted, 1))
    expected = chance[np.abs(noise) > angle].sum() / chance.sum()
    square = np.array([mean**2])
    found = beyond(angle, square, np.array([variance]), np.array([predicted]), 1, tails)
    assert found[0] == pytest.approx(expected, abs=1e-3)
    assert 0.5 < expected < 0.95


@given(st.floats(0.0, 9.0), st.floats(1e-6, 1.0), st.floats(0.0, 10.0))
def test_of_three_components_that_are_one_a_third_tells_of_tails(
    square: float, variance: float, predicted: float
) -> None:
    """All of three variances about one axis: tails are as likely as that component by itself has them."""
    one = np.ones(1)
    told = Tails(0.1 * one, 16.0 * one, one / 3)
    _, of_three = log_good(square * one, variance * one, predicted, 3, told)
    _, of_one = log_good(square * one, 3 * variance * one, 3 * predicted, 1, told._replace(told=one))
    np.testing.assert_allclose(of_three, of_one, rtol=1e-9)
