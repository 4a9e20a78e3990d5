"""Scores as probabilities."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.metrics import CalibrationBins, expected_calibration_error


def test_calibrated_scores_have_no_calibration_error() -> None:
    generator = torch.Generator().manual_seed(0)
    probability = torch.rand(200_000, generator=generator, dtype=torch.float64)
    happened = torch.rand(200_000, generator=generator) < probability
    assert expected_calibration_error(probability, happened) < 0.01
    assert expected_calibration_error(probability**3, happened) > 0.1


def test_bins_collect_what_is_added() -> None:
    bins = CalibrationBins()
    bins.add(torch.tensor([0.05, 0.95]), torch.tensor([False, True]))
    bins.add(torch.tensor([0.05, 1.0]), torch.tensor([True, True]))
    np.testing.assert_allclose(bins.rows, [[2, 0.05, 0.5], [2, 0.975, 1.0]])
