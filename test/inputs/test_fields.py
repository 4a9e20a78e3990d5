"""Precisions out of matrices."""

from __future__ import annotations

import numpy as np
import pytest

from rotavg_ros.inputs.fields import precision_of_covariance, precision_of_information


def test_precision_agrees_with_the_spread_of_rotation_vectors() -> None:
    rng = np.random.default_rng(0)
    deviation = 0.05
    vectors = rng.normal(scale=deviation, size=(20_000, 3))
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = np.cov(vectors.T)
    information = np.zeros((6, 6))
    information[3:, 3:] = np.linalg.inv(covariance[3:, 3:])
    assert precision_of_covariance(covariance.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_information(information.ravel()) == pytest.approx(deviation**-2, rel=0.03)
    assert precision_of_covariance(np.zeros(36)) == precision_of_information(np.zeros(36)) == 0.0
    assert precision_of_covariance(np.full(36, np.nan)) == 0.0  # from a sender who knows none
    assert precision_of_covariance(-covariance.ravel()) < 0  # refused later, as bad_precision
