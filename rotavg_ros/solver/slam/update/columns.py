"""The columns H⁻¹ Aᵀ of new closures, which stay valid until the next solve.

With H = L Lᵀ (:mod:`~rotavg_ros.solver.algebra.sparse.multifrontal`) only half of each is computed, L⁻¹ Aᵀ, which is
non-zero only in unknowns that are eliminated after a closure's ends. Products of halves give the covariances between
closures, and one more solve gives the step that all closures cause together. By rotations alone H⁻¹ Aᵀ is computed at
once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.slam.update.given import Given
from rotavg_ros.solver.slam.update.linear import Linear


@dataclass(frozen=True)
class _Rows:
    """The non-zero rows of a matrix with ``(K + R) d`` rows and m columns.

    Attributes:
        index: ``(s,)`` numbers of these rows.
        value: ``(s, m)`` the rows.
    """

    index: np.ndarray
    value: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray) -> _Rows:
        """The non-zero rows of ``((K + R) d, m)``."""
        index = np.flatnonzero(columns.any(axis=1))
        return cls(index, columns[index])

    def with_each(self, columns: np.ndarray) -> np.ndarray:
        """``(m, n)`` products of all columns with those of ``((K + R) d, n)``."""
        return product(self.value.T, columns[self.index])


@dataclass(frozen=True)
class Columns:
    """Columns of n new closures, d each.

    Attributes:
        edge: ``(n,)`` edges of the view-graph.
        left, half: parts of the closures, in the order in which they were added; ``left`` of one closure times ``half``
            of another is their covariance (:attr:`Linear.left`, :attr:`Linear.half`).
        covariance: ``(n d, n d)`` A H⁻¹ Aᵀ.
        anchors: ``(b,)`` blocks that the anchors of new nodes belong to, ascending.
        units: ``((K + R) d, b d)`` :attr:`Linear.left` of the unit columns of these blocks.
        at_anchors: ``(n d, b d)`` covariance of closures and these blocks.
        given: of the first closures, those that are good by what was known before any of them.
        surer: ``(N', d)`` rad² or m², by how much these lower the variances of the first new nodes.
    """

    edge: np.ndarray
    left: tuple[_Rows, ...]
    half: tuple[_Rows, ...]
    covariance: np.ndarray
    anchors: np.ndarray
    units: np.ndarray
    at_anchors: np.ndarray
    given: Given
    surer: np.ndarray

    @classmethod
    def none(cls) -> Columns:
        """The columns of no closures."""
        nothing, none = np.empty(0, dtype=np.int64), np.empty((0, 0))
        return cls(nothing, (), (), none, nothing, none, none, Given.none(0, 0), none)

    def and_of(self, linear: Linear, edge: np.ndarray, right: np.ndarray) -> Columns:
        """The columns of these closures and of more.

        Args:
            linear: the last solve, which all columns refer to.
            edge: ``(m,)`` the further closures.
            right: ``(K + R, d, m d)`` their Aᵀ.
        """
        left = linear.left(right)
        half = linear.half(left)
        rows = _Rows.of(left)
        between = self._with_all(self.left, half)
        own = rows.with_each(half)
        covariance = np.block([[self.covariance, between], [between.T, (own + own.T) / 2]])
        whole = _Rows.of(half)
        known = self.at_anchors
        if len(self.anchors):
            known = np.concatenate((known, whole.with_each(self.units)))
        return replace(
            self,
            edge=np.append(self.edge, edge),
            left=(*self.left, rows),
            half=(*self.half, whole),
            covariance=covariance,
            at_anchors=known,
        )

    def with_anchors(self, linear: Linear, blocks: np.ndarray) -> Columns:
        """The columns, with the covariances of closures and some blocks; few distinct blocks are expected."""
        if np.isin(blocks, self.anchors).all():
            return self
        d, anchors = linear.size, np.unique(blocks)
        units = np.zeros((linear.num_blocks, d, len(anchors), d))
        units[anchors, :, np.arange(len(anchors))] = np.eye(d)
        units = linear.left(units.reshape(linear.num_blocks, d, -1))
        return replace(self, anchors=anchors, units=units, at_anchors=self._with_all(self.half, units))

    def moves(self, linear: Linear, pull: np.ndarray) -> np.ndarray:
        """``(K + R, d, q)`` step H⁻¹ Aᵀ x for x ``(n d, q)``."""
        total = np.zeros((linear.num_blocks * linear.size, pull.shape[1]))
        first = 0
        for half in self.half:
            count = half.value.shape[1]
            _add_rows(total, half.index, product(half.value, pull[first : first + count]))
            first += count
        return linear.ended(total)

    def at(self, blocks: np.ndarray) -> np.ndarray:
        """``(…, d, n d)`` covariance of closures and ``(…)`` blocks, which :meth:`with_anchors` has been given."""
        count, told = len(self.anchors), self.at_anchors.T
        told = told.reshape(count, len(told) // max(count, 1), len(self.covariance))
        return np.asarray(told[np.searchsorted(self.anchors, blocks)])

    def _with_all(self, parts: tuple[_Rows, ...], columns: np.ndarray) -> np.ndarray:
        """``(n d, m)`` products of all parts' columns with those of ``((K + R) d, m)``."""
        return np.concatenate([np.empty((0, columns.shape[1])), *(part.with_each(columns) for part in parts)])


@compiled
def _add_rows(total: np.ndarray, index: np.ndarray, value: np.ndarray) -> None:
    """Add ``(s, q)`` to the rows ``(s,)`` of ``total``; no row occurs twice."""
    for i in range(len(index)):
        for j in range(value.shape[1]):
            total[index[i], j] += value[i, j]
