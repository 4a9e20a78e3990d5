"""Conditional normal densities of closures, given those among them that are believed.

Which closures are believed changes little from tick to tick, and from one round of judging them to the next. So the
inverse covariance of those is updated by what a few of them add or remove (the inverse of a partitioned matrix), which
takes time by the square of their number instead of its cube.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.products import inverse_of_positive, product
from rotavg_ros.solver.algebra.small_matrices import inverse

# Share of the given closures from which on a change of these is worked out from nothing.
_MANY = 0.25


class Change(NamedTuple):
    """What a change of the subset adds to the inverse covariance: ± across within acrossᵀ.

    Attributes:
        across: ``(n d, m)``.
        within: ``(m, m)``, with its sign.
    """

    across: np.ndarray
    within: np.ndarray

    @property
    def whole(self) -> np.ndarray:
        """``(n d, n d)`` the change itself."""
        return product(product(self.across, self.within), np.ascontiguousarray(self.across.T))

    def told(self, rows: np.ndarray) -> np.ndarray:
        """``(k,)`` the change of :meth:`Given.told` for ``(k, n d)``."""
        across = product(rows, self.across)
        return np.asarray((product(across, self.within) * across).sum(axis=1))


@dataclass(frozen=True)
class Given:
    """A subset of n closures whose residuals are given.

    Attributes:
        is_given: ``(n,)`` bool, the subset.
        precision: ``(n d, n d)`` inverse covariance of its residuals; 0 for all others.
    """

    is_given: np.ndarray
    precision: np.ndarray

    @classmethod
    def none(cls, count: int, size: int) -> Given:
        """None of n closures of d components."""
        return cls(np.zeros(count, dtype=bool), np.zeros((count * size, count * size)))

    @classmethod
    def of(cls, covariance: np.ndarray, is_given: np.ndarray) -> Given:
        """From the covariance ``(n, d, n, d)`` of all closures."""
        count, size = covariance.shape[:2]
        among = covariance[is_given][:, :, is_given].reshape(2 * (int(is_given.sum()) * size,))
        precision = np.zeros((count, size, count, size))
        inside = np.flatnonzero(is_given)
        inverted = inverse_of_positive((among + among.T) / 2).reshape(len(inside), size, len(inside), size)
        precision[inside[:, None], :, inside] = inverted.transpose(0, 2, 1, 3)
        return cls(is_given, precision.reshape(count * size, -1))

    def changed_to(self, covariance: np.ndarray, is_given: np.ndarray) -> tuple[Given, list[Change] | None]:
        """The same for another subset, and how the inverse covariance has changed; None: it is a new one.

        Args:
            covariance: ``(n', d, n', d)`` of n' ≥ n closures, the same as before between the first n.
            is_given: ``(n',)`` bool.
        """
        count, size = covariance.shape[:2]
        before = np.zeros(count, dtype=bool)
        before[: len(self.is_given)] = self.is_given
        come, gone = np.flatnonzero(is_given & ~before), np.flatnonzero(before & ~is_given)
        if len(come) + len(gone) > _MANY * before.sum():
            return Given.of(covariance, is_given), None
        precision = np.zeros((count * size, count * size))
        precision[: len(self.precision), : len(self.precision)] = self.precision
        changes = []
        if len(gone):
            row = _rows(gone, size)
            changes.append(_without(precision, row))
            precision += changes[-1].whole
            precision[row] = precision[:, row] = 0.0
        if len(come):
            changes.append(_with(precision, covariance, _rows(come, size)))
            precision += changes[-1].whole
        return Given(is_given, precision), changes

    def told(self, rows: np.ndarray) -> np.ndarray:
        """``(m,)`` by how much the subset lowers the variances of what covaries with all closures as ``(m, n d)``."""
        return np.asarray((product(rows, self.precision) * rows).sum(axis=1))

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
        told = product(precision, residual.reshape(count * size, -1))
        between = covariance[others].reshape(-1, count * size)
        mean[others] -= product(between, told).reshape(mean[others].shape)
        by_row = (-1, size, count * size)
        gain = product(between, precision)
        left[others] -= np.matmul(gain.reshape(by_row), between.reshape(by_row).transpose(0, 2, 1))
        blocks = precision.reshape(count, size, count, size)[inside, :, inside][given]
        left[given] = inverse((blocks + blocks.transpose(0, 2, 1)) / 2)
        mean[given] = left[given] @ told.reshape(residual.shape)[given]
        return mean, (left + left.transpose(0, 2, 1)) / 2


def _rows(closure: np.ndarray, size: int) -> np.ndarray:
    """``(n d,)`` rows of closures ``(n,)``."""
    return np.asarray((closure[:, None] * size + np.arange(size)).ravel())


def _with(precision: np.ndarray, covariance: np.ndarray, row: np.ndarray) -> Change:
    """The change where rows ``(m,)`` come."""
    to_all = covariance.reshape(precision.shape)[row]
    across = -product(precision, np.ascontiguousarray(to_all.T))
    across[row] += np.eye(len(row))
    unexplained = product(to_all, across)
    return Change(across, inverse_of_positive((unexplained + unexplained.T) / 2))


def _without(precision: np.ndarray, row: np.ndarray) -> Change:
    """The change where rows ``(m,)`` go."""
    own = precision[row][:, row]
    return Change(np.ascontiguousarray(precision[:, row]), -inverse_of_positive((own + own.T) / 2))
