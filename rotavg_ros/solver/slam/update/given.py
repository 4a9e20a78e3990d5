"""Conditional normal densities of closures, given those among them that are believed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.products import inverse_of_positive, product
from rotavg_ros.solver.algebra.small_matrices import inverse


@dataclass(frozen=True)
class Given:
    """A subset of n closures whose residuals are given.

    Attributes:
        is_given: ``(n,)`` bool, the subset.
        precision: ``(g d, g d)`` inverse covariance of its residuals.
    """

    is_given: np.ndarray
    precision: np.ndarray

    @classmethod
    def of(cls, covariance: np.ndarray, is_given: np.ndarray) -> Given:
        """From the covariance ``(n, d, n, d)`` of all closures."""
        count = int(is_given.sum()) * covariance.shape[1]
        among = covariance[is_given][:, :, is_given].reshape(count, count)
        return cls(is_given, inverse_of_positive((among + among.T) / 2))

    def left_out(self, covariance: np.ndarray, residual: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Residuals ``(n, d, q)`` minus their conditional means given the subset, and the covariances ``(n, d, d)``.

        A closure of the subset is conditioned on its other members.

        Args:
            covariance: ``(n, d, n, d)`` of all closures.
            residual: ``(n, d, q)``.
        """
        count, size = residual.shape[:2]
        inside, given, others = np.arange(count), self.is_given, ~self.is_given
        left = covariance[inside, :, inside]
        if not given.any():
            return residual, left
        mean, precision = residual.copy(), self.precision
        off = residual[given].reshape(len(precision), -1)
        between = covariance[others][:, :, given].reshape(-1, len(precision))
        gain = product(between, precision)
        mean[others] -= product(gain, off).reshape(mean[others].shape)
        by_row = (-1, size, len(precision))
        left[others] -= np.matmul(gain.reshape(by_row), between.reshape(by_row).transpose(0, 2, 1))
        among = np.arange(given.sum())
        blocks = precision.reshape(-1, size, len(among), size)[among, :, among]
        left[given] = inverse((blocks + blocks.transpose(0, 2, 1)) / 2)
        mean[given] = left[given] @ product(precision, off).reshape(-1, size, residual.shape[2])
        return mean, (left + left.transpose(0, 2, 1)) / 2
