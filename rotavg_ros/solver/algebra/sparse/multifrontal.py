"""Cholesky's factor of a sparse symmetric matrix of blocks, and the inverse at its entries, by dense fronts.

Small fronts are processed by loops (:mod:`~rotavg_ros.solver.algebra.sparse.fronts`), many at once. A large one is
processed by products of dense matrices, which take a tenth of the time of loops over entries. A solve may rest between
them, and other threads run during them.
"""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.solver.algebra.sparse import fronts
from rotavg_ros.solver.algebra.sparse.elimination import Elimination, Stretch
from rotavg_ros.solver.algebra.sparse.fronts import Room
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import spend, stop_if_abandoned

# Where rounding leaves a large front without a positive pivot, its diagonal is raised by the first share of its largest
# diagonal entry, then by the second number times as much each time, up to the third share.
_LIFT, _MORE, _NO_ROUNDING = 1e-15, 16.0, 1.0
# Work of the inverse relative to that of the factor.
_INVERSE = 2.0
# Number of columns from which products of whole matrices pay off.
_MANY = 4
_NOT_DEFINITE = "a matrix that is to be factorised is not positive definite"


class Cholesky:
    """The factorisation Uᵀ U of a matrix.

    Args:
        elimination: of its pattern.
        entries: ``(num_entries,)`` the matrix at :meth:`Elimination.places`; of diagonal blocks, the upper triangle is
            enough.

    Raises:
        RuntimeError: the matrix is far from positive definite.
    """

    def __init__(self, elimination: Elimination, entries: np.ndarray) -> None:
        self.elimination = elimination
        shape = elimination.shape
        self._store, stack = _numbers(elimination.num_factor_entries), _numbers(elimination.num_waiting)
        room, top = Room(entries, self._store, stack, _numbers(elimination.most_rows**2)), 0
        for stretch in elimination.stretches:
            stop_if_abandoned()
            spend(stretch.units)
            if stretch.is_dense:
                top = self._eliminate_dense(stretch.first, room, top)
            else:
                top = fronts.eliminate(shape, stretch.first, stretch.last, room, top)
            if top < 0:
                raise RuntimeError(_NOT_DEFINITE)

    def _own(self, front: int) -> np.ndarray:
        """``(p, p + r)`` a front's part of the factor."""
        shape = self.elimination.shape
        num_pivots = shape.begin[front + 1] - shape.begin[front]
        width = num_pivots + shape.row_begin[front + 1] - shape.row_begin[front]
        begin = shape.store[front]
        return self._store[begin : begin + num_pivots * width].reshape(num_pivots, width)

    def _eliminate_dense(self, front: int, room: Room, top: int) -> int:
        """As :func:`fronts.eliminate`, for one large front."""
        own = self._own(front)
        num_pivots = len(own)
        num_rows = own.shape[1] - num_pivots
        left = room.work[: num_rows**2].reshape(num_rows, num_rows)
        top = fronts.gather(self.elimination.shape, front, room, own, left, top)
        matrix, remaining = torch.from_numpy(own), torch.from_numpy(left)
        lower = _lower_root(matrix[:, :num_pivots].T)
        matrix[:, :num_pivots] = lower.T
        beside = torch.linalg.solve_triangular(lower, matrix[:, num_pivots:], upper=False)
        matrix[:, num_pivots:] = beside
        remaining.addmm_(beside.T, beside, alpha=-1.0)
        room.stack[top : top + num_rows**2] = left.ravel()
        return int(top + num_rows**2)

    @property
    def num_entries(self) -> int:
        """Number of entries of the factor."""
        return self.elimination.num_factor_entries

    @property
    def log_det(self) -> float:
        """Log determinant of the matrix."""
        shape = self.elimination.shape
        pivots, rows = np.diff(shape.begin), np.diff(shape.row_begin)
        number = np.arange(shape.begin[-1]) - np.repeat(shape.begin[:-1], pivots)
        diagonal = np.repeat(shape.store[:-1], pivots) + number * (np.repeat(pivots + rows, pivots) + 1)
        return 2 * float(np.log(self._store[diagonal]).sum())

    def solve(self, right_hand_side: np.ndarray, units: float = 0.0) -> np.ndarray:
        """The solution for ``(B d, k)`` columns, blocks in the order of elimination; ``units`` as in :meth:`ended`."""
        return self.ended(self.begun(right_hand_side, units / 2), units / 2)

    def begun(self, right_hand_side: np.ndarray, units: float = 0.0) -> np.ndarray:
        """U⁻ᵀ of columns ``(B d, k)``; fronts where these are zero take no time. ``units`` as in :meth:`ended`."""
        shape, columns = self.elimination.shape, np.array(right_hand_side, order="C")
        for stretch in self.elimination.stretches:
            self._spend(units, stretch)
            if not stretch.is_dense or columns.shape[1] < _MANY:
                fronts.solve_lower(shape, stretch.first, stretch.last, self._store, columns)
                continue
            upper, beside, pivots, row = self._dense(stretch.first)
            own = torch.from_numpy(columns[pivots])
            if own.any():
                own.copy_(torch.linalg.solve_triangular(upper.T, own, upper=False))
                columns[row] -= (beside.T @ own).numpy()
        return columns

    def ended(self, half: np.ndarray, units: float = 0.0) -> np.ndarray:
        """U⁻¹ of columns ``(B d, k)``.

        Args:
            half: the columns.
            units: units of work, spent stretch by stretch; 0: they are counted elsewhere.
        """
        shape, columns = self.elimination.shape, np.array(half, order="C")
        for stretch in reversed(self.elimination.stretches):
            self._spend(units, stretch)
            if not stretch.is_dense or columns.shape[1] < _MANY:
                fronts.solve_upper(shape, stretch.first, stretch.last, self._store, columns)
                continue
            upper, beside, pivots, row = self._dense(stretch.first)
            own = torch.from_numpy(columns[pivots])
            told = torch.addmm(own, beside, torch.from_numpy(columns[row]), alpha=-1.0)
            own.copy_(torch.linalg.solve_triangular(upper, told, upper=True))
        return columns

    def _spend(self, units: float, stretch: Stretch) -> None:
        """Spend a stretch's share of the units; the solve may rest here even if they are 0."""
        spend(units * stretch.units / self.elimination.units)

    def _dense(self, front: int) -> tuple[torch.Tensor, torch.Tensor, slice, np.ndarray]:
        """U of a front's pivots and of its rows, and the positions of pivots and rows in a column."""
        shape, own = self.elimination.shape, torch.from_numpy(self._own(front))
        row = shape.row[shape.row_begin[front] : shape.row_begin[front + 1]]
        return own[:, : len(own)], own[:, len(own) :], slice(shape.begin[front], shape.begin[front + 1]), row

    @cached_property
    def inverse(self) -> np.ndarray:
        """``(num_entries,)`` the inverse at the matrix's entries."""
        elimination = self.elimination
        shape, found, top = elimination.shape, np.empty(elimination.num_entries), 0
        stack, work = _numbers(elimination.num_waiting), _numbers(elimination.most_unknowns**2)
        room = Room(found, self._store, stack, work)
        for stretch in reversed(elimination.stretches):
            stop_if_abandoned()
            spend(_INVERSE * stretch.units)
            if stretch.is_dense:
                top = self._invert_dense(stretch.first, room, top)
            else:
                top = fronts.invert(shape, stretch.first, stretch.last, room, top)
        return found

    def _invert_dense(self, front: int, room: Room, top: int) -> int:
        """As :func:`fronts.invert`, for one large front."""
        own = self._own(front)
        num_pivots, width = own.shape
        num_rows = width - num_pivots
        top -= num_rows**2
        found = room.work[: width**2].reshape(width, width)
        found[num_pivots:, num_pivots:] = room.stack[top : top + num_rows**2].reshape(num_rows, num_rows)
        matrix, whole = torch.from_numpy(own), torch.from_numpy(found)
        upper = matrix[:, :num_pivots]
        told = torch.linalg.solve_triangular(upper, matrix[:, num_pivots:], upper=True)
        across = -(told @ whole[num_pivots:, num_pivots:])
        whole[:num_pivots, num_pivots:], whole[num_pivots:, :num_pivots] = across, across.T
        within = torch.cholesky_inverse(upper, upper=True)
        whole[:num_pivots, :num_pivots] = within.addmm_(told, across.T, alpha=-1.0)
        return fronts.hand_down(self.elimination.shape, front, found, room, top)


def _numbers(count: int) -> np.ndarray:
    """An uninitialised array of torch's, in which products are the same to the last bit wherever it lies."""
    return np.asarray(torch.empty(count, dtype=torch.float64).numpy())


def _lower_root(matrix: torch.Tensor) -> torch.Tensor:
    """L of L Lᵀ = the matrix, by its lower triangle; its diagonal is raised where rounding has left no root."""
    lower: torch.Tensor
    lower, info = torch.linalg.cholesky_ex(matrix)
    lift = _LIFT
    while int(info):
        if lift > _NO_ROUNDING:
            raise RuntimeError(_NOT_DEFINITE)
        diagonal = matrix.diagonal()
        diagonal += lift * float(diagonal.abs().max())
        lower, info = torch.linalg.cholesky_ex(matrix)
        lift *= _MORE
    return lower
