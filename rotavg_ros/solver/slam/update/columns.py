"""What new closures would move: columns H⁻¹ Aᵀ, which stay as they are until the next solve.

With H = L Lᵀ (:mod:`~rotavg_ros.solver.algebra.sparse.multifrontal`) only half of each is worked out, L⁻¹ Aᵀ, which has
numbers in what is eliminated after a closure's ends and nowhere else. Halves tell what closures have in common,
and what all of them together move takes one more solve, however many they are. By rotations alone both halves are
worked out at once.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.slam.update.linear import Linear


@dataclass(frozen=True)
class _Rows:
    """Some rows of ``(K + R) d``, the others nothing.

    Attributes:
        index: ``(s,)`` which.
        value: ``(s, m)``.
    """

    index: np.ndarray
    value: np.ndarray

    @classmethod
    def of(cls, columns: np.ndarray) -> _Rows:
        """Of ``((K + R) d, m)``."""
        index = np.flatnonzero(columns.any(axis=1))
        return cls(index, columns[index])

    def with_each(self, columns: np.ndarray) -> np.ndarray:
        """``(m, n)`` products with ``((K + R) d, n)``."""
        return product(self.value.T, columns[self.index])


@dataclass(frozen=True)
class Columns:
    """Columns of n new closures, d rows each.

    Attributes:
        edge: ``(n,)`` edges of the view-graph.
        left, half: as they came; the product of one's left with the other's half is what two have in common.
        covariance: ``(n d, n d)`` A H⁻¹ Aᵀ.
        anchors: ``(b,)`` blocks, ascending, that new nodes hang on.
        units: ``((K + R) d, b d)`` what is left of columns that are one in these.
        at_anchors: ``(n d, b d)`` what closures have in common with them.
    """

    edge: np.ndarray
    left: tuple[_Rows, ...]
    half: tuple[_Rows, ...]
    covariance: np.ndarray
    anchors: np.ndarray
    units: np.ndarray
    at_anchors: np.ndarray

    @classmethod
    def none(cls) -> Columns:
        """The columns of no closures."""
        nothing = np.empty(0, dtype=np.int64)
        return cls(nothing, (), (), np.empty((0, 0)), nothing, np.empty((0, 0)), np.empty((0, 0)))

    def and_of(self, linear: Linear, edge: np.ndarray, right: np.ndarray) -> Columns:
        """With more closures.

        Args:
            linear: that all columns are of.
            edge: ``(m,)``.
            right: ``(K + R, d, m d)`` Aᵀ.
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
        """That know of some blocks, the same ones rather than many, what closures have in common with them."""
        if np.isin(blocks, self.anchors).all():
            return self
        d, anchors = linear.size, np.unique(blocks)
        units = np.zeros((linear.num_blocks, d, len(anchors), d))
        units[anchors, :, np.arange(len(anchors))] = np.eye(d)
        units = linear.left(units.reshape(linear.num_blocks, d, -1))
        return replace(self, anchors=anchors, units=units, at_anchors=self._with_all(self.half, units))

    def moves(self, linear: Linear, pull: np.ndarray) -> np.ndarray:
        """``(K + R, d, q)`` what moves where so much pulls at each row, ``(n d, q)``."""
        total = np.zeros((linear.num_blocks * linear.size, pull.shape[1]))
        first = 0
        for half in self.half:
            count = half.value.shape[1]
            _add_rows(total, half.index, product(half.value, pull[first : first + count]))
            first += count
        return linear.ended(total)

    def at(self, blocks: np.ndarray) -> np.ndarray:
        """``(…, d, n d)`` of blocks, which :meth:`with_anchors` was told of."""
        count, told = len(self.anchors), self.at_anchors.T
        told = told.reshape(count, len(told) // max(count, 1), len(self.covariance))
        return np.asarray(told[np.searchsorted(self.anchors, blocks)])

    def _with_all(self, parts: tuple[_Rows, ...], columns: np.ndarray) -> np.ndarray:
        """``(n d, m)`` products of some ``parts`` with ``((K + R) d, m)``."""
        return np.concatenate([np.empty((0, columns.shape[1])), *(part.with_each(columns) for part in parts)])


@compiled
def _add_rows(total: np.ndarray, index: np.ndarray, value: np.ndarray) -> None:
    """``(s, q)`` to the rows ``(s,)`` of ``total``, each of which is named once."""
    for i in range(len(index)):
        for j in range(value.shape[1]):
            total[index[i], j] += value[i, j]
