"""Verdicts on edges, and the scores behind them, compared with the truth."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np
from torch import Tensor


@dataclass(frozen=True)
class OutlierCounts:
    """How verdicts on edges compare with the truth."""

    true_positives: int
    false_positives: int
    false_negatives: int
    true_negatives: int

    @classmethod
    def of(cls, flagged: Tensor, is_outlier: Tensor) -> OutlierCounts:
        """From flags and truth, both ``(M,)`` bool."""
        return cls(
            int((flagged & is_outlier).sum()),
            int((flagged & ~is_outlier).sum()),
            int((~flagged & is_outlier).sum()),
            int((~flagged & ~is_outlier).sum()),
        )

    def __add__(self, other: OutlierCounts) -> OutlierCounts:
        """Verdicts of both together."""
        return OutlierCounts(*(ours + theirs for ours, theirs in zip(astuple(self), astuple(other), strict=True)))

    @property
    def num_outliers(self) -> int:
        return self.true_positives + self.false_negatives

    @property
    def num_inliers(self) -> int:
        return self.false_positives + self.true_negatives

    @property
    def precision(self) -> float:
        """Share of the flagged edges that are outliers; 1 if none is flagged."""
        flagged = self.true_positives + self.false_positives
        return self.true_positives / flagged if flagged else 1.0

    @property
    def recall(self) -> float:
        """Share of the outliers that are flagged; 1 if there is none."""
        return self.true_positives / self.num_outliers if self.num_outliers else 1.0

    @property
    def accuracy(self) -> float:
        total = self.true_positives + self.false_positives + self.false_negatives + self.true_negatives
        return (self.true_positives + self.true_negatives) / total if total else 1.0

    @property
    def false_alarm_rate(self) -> float:
        """Share of the inliers that are flagged; 0 if there is none."""
        return self.false_positives / self.num_inliers if self.num_inliers else 0.0


def roc_area(value: np.ndarray, is_positive: np.ndarray) -> float:
    """Probability that a positive's value exceeds a negative's, ties counting half (Mann–Whitney).

    Args:
        value: ``(M,)``; is_positive: ``(M,)`` bool.
    """
    positives = int(is_positive.sum())
    negatives = len(is_positive) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    # Ranks from 1; equal values share their mean rank. scipy.stats has this, too, but would cost every replay 30 MB.
    _, place, count = np.unique(value, return_inverse=True, return_counts=True)
    rank = np.cumsum(count) - (count - 1) / 2
    rank_sum = rank[place][is_positive].sum()
    return float((rank_sum - positives * (positives + 1) / 2) / (positives * negatives))
