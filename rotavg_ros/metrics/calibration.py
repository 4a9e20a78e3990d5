"""Is a score a probability? Reliability of outlier scores."""

from __future__ import annotations

import numpy as np
from torch import Tensor

_BINS = 15


class CalibrationBins:
    """Scores and outcomes of any number of graphs, collected in bins of equal width.

    Args:
        bins: number of bins on [0, 1].
    """

    def __init__(self, bins: int = _BINS) -> None:
        self._count, self._score_sum, self._happened = (np.zeros(bins) for _ in range(3))

    def add(self, probability: Tensor, happened: Tensor) -> None:
        """Count ``(M,)`` probabilities in [0, 1] and whether their events happened, ``(M,)`` bool."""
        scores, truth = probability.double().cpu().numpy(), happened.double().cpu().numpy()
        bins = len(self._count)
        bin_of = np.minimum((scores * bins).astype(np.int64), bins - 1)
        self._count += np.bincount(bin_of, minlength=bins)
        self._score_sum += np.bincount(bin_of, scores, bins)
        self._happened += np.bincount(bin_of, truth, bins)

    def extend(self, other: CalibrationBins) -> None:
        """Add the counts of another with the same number of bins."""
        self._count += other._count
        self._score_sum += other._score_sum
        self._happened += other._happened

    @property
    def rows(self) -> np.ndarray:
        """Rows ``(count, mean probability, observed share)`` of the bins that are not empty."""
        filled = self._count > 0
        count = self._count[filled]
        return np.stack((count, self._score_sum[filled] / count, self._happened[filled] / count), axis=1)

    @property
    def error(self) -> float:
        """Expected calibration error: mean distance of stated probability and observed share, weighted by count."""
        rows = self.rows
        return float((rows[:, 0] * np.abs(rows[:, 1] - rows[:, 2])).sum() / max(rows[:, 0].sum(), 1))


def expected_calibration_error(probability: Tensor, happened: Tensor, bins: int = _BINS) -> float:
    """:attr:`CalibrationBins.error` of one set of scores."""
    collected = CalibrationBins(bins)
    collected.add(probability, happened)
    return collected.error
