"""Is a score a probability? Reliability of outlier scores."""

from __future__ import annotations

import numpy as np
from torch import Tensor


def reliability(probability: Tensor, happened: Tensor, bins: int = 15) -> np.ndarray:
    """Rows ``(count, mean probability, observed share)`` of equal-width bins that are not empty.

    Args:
        probability: ``(M,)`` in [0, 1].
        happened: ``(M,)`` bool.
    """
    scores, truth = probability.double().cpu().numpy(), happened.double().cpu().numpy()
    bin_of = np.minimum((scores * bins).astype(np.int64), bins - 1)
    count = np.bincount(bin_of, minlength=bins)
    filled = count > 0
    mean = np.bincount(bin_of, scores, bins)[filled] / count[filled]
    share = np.bincount(bin_of, truth, bins)[filled] / count[filled]
    return np.stack((count[filled].astype(np.float64), mean, share), axis=1)


def expected_calibration_error(probability: Tensor, happened: Tensor, bins: int = 15) -> float:
    """Mean distance of stated probability and observed share over the bins, weighted by their counts."""
    rows = reliability(probability, happened, bins)
    return float((rows[:, 0] * np.abs(rows[:, 1] - rows[:, 2])).sum() / max(rows[:, 0].sum(), 1))
