"""The share of good closures among those that came together, and who is good by it."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import minimize_scalar

from rotavg_ros.online.answer.arrivals import FALSE, GAP, GOOD, Arrivals, beside, log_odds_of_share
from rotavg_ros.solver.diagnosis import SlamPriors


def drawn(good: int, false: int, deviation: float, seed: int = 0) -> np.ndarray:
    """Log-odds of closures about one axis: normal errors, and any turn."""
    rng = np.random.default_rng(seed)
    turned = np.append(rng.normal(0, deviation, good), rng.uniform(-np.pi, np.pi, false))
    return np.log(2 * np.pi) - np.log(2 * np.pi * deviation**2) / 2 - turned**2 / (2 * deviation**2)


@given(good=st.integers(0, 60), false=st.integers(0, 60), seed=st.integers(0, 50))
@settings(max_examples=40, deadline=None)
def test_the_share_has_the_greatest_posterior(good: int, false: int, seed: int) -> None:
    """Of the prior's density and the likelihood, as a density of log π − log (1 − π)."""
    log_odds = drawn(good, false, 0.1, seed)

    def minus_log_posterior(logit: float) -> float:
        share = 1 / (1 + np.exp(-logit))
        prior = GOOD * np.log(share) + FALSE * np.log1p(-share)
        return -prior - float(np.logaddexp(np.log(share) + log_odds, np.log1p(-share)).sum())

    if len(log_odds) == 0:
        return
    best = minimize_scalar(minus_log_posterior, bounds=(-12, 12), method="bounded", options={"xatol": 1e-8}).x
    assert log_odds_of_share(log_odds, np.zeros(len(log_odds), dtype=int))[0] == pytest.approx(best, abs=1e-4)


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("false", [2000, 20_000])
def test_of_random_ones_none_is_good(false: int, seed: int) -> None:
    """Though an answer that errs by 5° explains one in fifteen."""
    log_odds = drawn(0, false, np.radians(5), seed)
    prior = log_odds_of_share(log_odds, np.zeros(false, dtype=int))
    assert (log_odds > 0).mean() > 0.05 and not (log_odds + prior > 0).any()


def test_good_ones_among_them_are_as_many_as_there_are() -> None:
    """By the number of probabilities above one half, and by their sum."""
    log_odds = drawn(2000, 8000, np.radians(2), 1)
    share = 1 / (1 + np.exp(-log_odds_of_share(log_odds, np.zeros(len(log_odds), dtype=int))[0]))
    assert share == pytest.approx(0.2, abs=0.02)


def test_each_group_has_its_own_share_whatever_the_order() -> None:
    log_odds = np.concatenate((drawn(300, 10, 0.05), drawn(0, 500, 0.05)))
    group = np.repeat([0, 1], [310, 500])
    order = np.random.default_rng(0).permutation(len(group))
    found = log_odds_of_share(log_odds, group)
    np.testing.assert_allclose(log_odds_of_share(log_odds[order], group[order]), found, atol=1e-9)
    assert found[0] > 2 and found[1] < -4


def test_what_has_entered_counts_as_it_did_before() -> None:
    """Those that are left come of the same share; what enters cannot bear itself out."""
    arrivals, told = Arrivals(), drawn(100, 900, 0.05)
    arrivals.take(np.ones(1000, dtype=bool), np.zeros(1000, dtype=bool))
    nobody = np.zeros(0, dtype=np.int64)
    before = arrivals.prior_log_odds(np.arange(1000), told, nobody)
    left = np.arange(100, 1000)
    after = arrivals.prior_log_odds(left, told[left], nobody)
    np.testing.assert_allclose(after, before[left])


def test_those_at_the_newest_keyframes_and_those_of_each_tick_are_groups() -> None:
    arrivals = Arrivals()
    is_closure, at_newest = np.array([True, True, False]), np.array([False, True, True])
    arrivals.take(is_closure, at_newest)
    arrivals.take(np.append(is_closure, [True, True]), np.append(at_newest, [True, True]))
    assert arrivals.group.tolist() == [0, 1, -1, 3, 3]
    assert arrivals.num_together(np.array([0, 1, 3, 4])).tolist() == [2, 2, 2, 2]


def test_good_ones_beside_believed_ones_are_told_from_random_ones_among_them() -> None:
    """Of a flood of which one in sixteen is good: most good ones come beside those that are believed."""
    rng = np.random.default_rng(0)
    believed = np.stack((np.arange(0.0, 3000.0, 4.0), np.arange(0.0, 3000.0, 4.0) + 400.0), axis=1)
    good = believed[rng.integers(0, len(believed), 130)] + rng.integers(-3, 4, (130, 2))
    ends, is_good = np.concatenate((good, rng.uniform(0, 3000, (2000, 2)))), np.arange(2130) < 130
    told, believed_alone, right = drawn(130, 2000, np.radians(2), 1), [], []
    alike = np.zeros(2130, dtype=np.int64), np.zeros(len(believed), dtype=np.int64)
    apart = beside(ends, believed), beside(believed, believed, is_one=True)
    for nearness, of_believed in (alike, apart):
        arrivals = Arrivals()
        arrivals.take(np.ones(2130, dtype=bool), np.zeros(2130, dtype=bool))
        arrivals.beside[:] = nearness
        enters = told + arrivals.prior_log_odds(np.arange(2130), told, of_believed) > 0
        believed_alone.append(int((enters & ~is_good).sum()))
        right.append(int((enters & is_good).sum()))
    assert believed_alone[1] < 0.5 * believed_alone[0]
    assert right[1] > 0.95 * right[0]


def test_how_near_closures_are_to_believed_ones() -> None:
    believed = np.array([[100.0, 10.0], [500.0, 300.0]])
    asked = np.array([[10.0, 100.0], [11.0, 102.0], [304.0, 504.0], [100.0, 500.0]])
    assert beside(asked, believed).tolist() == [0, 2, 3, 6]
    assert beside(asked, np.empty((0, 2))).tolist() == [6] * 4
    assert len(beside(np.empty((0, 2)), believed)) == 0
    twins = np.array([[5.0, 50.0], [51.0, 6.0], [500.0, 50.0]])
    assert beside(twins, twins, is_one=True).tolist() == [1, 1, 6]


def test_where_no_share_makes_one_good_nobody_asks_again_how_near_it_is() -> None:
    arrivals = Arrivals()
    arrivals.take(np.ones(3, dtype=bool), np.zeros(3, dtype=bool))
    told = np.array([2.0, -5.0, -100.0])
    assert arrivals.are_open(np.arange(3), told).all()
    arrivals.prior_log_odds(np.arange(3), told, np.zeros(0, dtype=np.int64))
    assert arrivals.are_open(np.arange(3), told).tolist() == [True, True, False]


def test_the_share_of_good_closures_is_believed_beforehand_as_in_the_solver() -> None:
    priors = SlamPriors()
    share, count = priors.outlier_share, priors.outlier_count
    np.testing.assert_allclose([GOOD, FALSE], [(1 - share) * count, share * count])
    assert priors.run_gap_steps == GAP
