"""Verdicts on edges against the truth."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.stats import mannwhitneyu

from rotavg_ros.metrics import OutlierCounts, roc_area


def test_counts() -> None:
    flagged, is_outlier = torch.tensor([1, 1, 1, 0, 0]).bool(), torch.tensor([1, 1, 0, 1, 0]).bool()
    counts = OutlierCounts.of(flagged, is_outlier)
    assert (counts.precision, counts.recall, counts.accuracy, counts.false_alarm_rate) == (2 / 3, 2 / 3, 0.6, 0.5)
    assert counts + OutlierCounts(1, 2, 3, 4) == OutlierCounts(3, 3, 4, 5)
    nothing = OutlierCounts(0, 0, 0, 0)
    assert (nothing.precision, nothing.recall, nothing.accuracy, nothing.false_alarm_rate) == (1, 1, 1, 0)


def test_roc_area_counts_pairs_in_the_right_order() -> None:
    value, is_positive = np.array([0.1, 0.4, 0.4, 0.9]), np.array([False, True, False, True])
    assert roc_area(value, is_positive) == pytest.approx((1 + 0.5 + 1 + 1) / 4)
    assert np.isnan(roc_area(value, np.zeros(4, dtype=bool)))


def test_roc_area_is_the_mann_whitney_statistic() -> None:
    rng = np.random.default_rng(0)
    value, is_positive = rng.integers(0, 20, 300) / 20, rng.random(300) < 0.3
    statistic = mannwhitneyu(value[is_positive], value[~is_positive]).statistic
    pairs = is_positive.sum() * (~is_positive).sum()
    assert roc_area(value, is_positive) == pytest.approx(statistic / pairs, abs=1e-12)
