"""L D Lᵀ of a sparse symmetric positive definite matrix, and those entries of its inverse that its own rows need.

H = Jᵀ W J, where a row of J has at most three unknowns. L is computed row by row along the elimination tree (Liu 1990;
Davis 2005).
Wherever L has an entry, the inverse Z follows from those to its lower right (Takahashi, Fagan and Chin 1973; Erisman
and Tinney 1975), column j after all later ones:

    Z_ij = − Σ_k Z_ik L_kj,    Z_jj = 1 / D_j − Σ_k L_kj Z_kj,    i, k where column j of L has entries.

So the variance of each of H's own rows, j H⁻¹ jᵀ, is exact and costs about two factors. For any other pair of unknowns

    Z_uv = Σ_j y_j z_j / D_j,    L y = e_u,  L z = e_v,

and y has entries only on u's path up the elimination tree.

Closures between distant nodes leave a clique of unknowns at the end of any order, and nearly all the arithmetic is
there. L's last columns, which are full, are computed by a dense factor, and Z's by a dense inverse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.algebra.sparse import ldl_loops as loops
from rotavg_ros.solver.algebra.sparse.elimination_tree import elimination_tree, factor_rows
from rotavg_ros.solver.algebra.sparse.ldl_loops import Shape
from rotavg_ros.solver.algebra.sparse.sparse_factor import order_of_little_fill
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import spend

_NOWHERE = -1
# Number of full columns from which a dense factor pays off.
_MANY = 100
# Products per unit of work: of columns, of a dense factor, and of entries with rows that are followed up the tree.
_PRODUCTS, _DENSE_PRODUCTS, _FAR_PRODUCTS = 1e6, 2e7, 2.4e6
# Most rows that are followed up the tree at once; and most numbers in memory for unknowns that are.
_IN_MEMORY, _NUMBERS = 1024, 2e7


class RowPattern:
    """Where H and L have entries, for rows of certain unknowns in a certain order of elimination.

    Args:
        column: ``(E, 3)`` unknowns of each row.
        value: ``(E, 3)`` J's entries there; 0: the row does not have that unknown.
        size: N unknowns.
        rank: ``(N,)`` position of each in the order of elimination; None: an order of little fill is found.

    Attributes:
        rank: the same.
        num_entries: number of entries of H, on the diagonal and on one side of it.
        num_factor_entries: number of entries of L.
        units: units of work of a factor, by its products; the inverse at its entries takes as much.
    """

    def __init__(self, column: np.ndarray, value: np.ndarray, size: int, rank: np.ndarray | None = None) -> None:
        if rank is None:
            rank = order_of_little_fill(*_ties(column, value), size)
        self.rank, self.node = rank, np.argsort(rank)
        self.size = size
        self.column, self.value = rank[column].astype(np.int32), np.ascontiguousarray(value)
        begin, row, self._slot = _lay_out(self.column, self.value, size)
        above, counts = elimination_tree(begin, row)
        factor_begin = np.append(0, np.cumsum(counts))
        rows = factor_rows(begin, row, above, factor_begin)
        self.shape = Shape(begin, row, above, factor_begin, rows, _first_full(counts))
        # As floating-point numbers: integers overflow with millions of unknowns.
        by_column = counts[: self.shape.full].astype(np.float64) ** 2
        self.units = float(by_column.sum()) / _PRODUCTS + float(size - self.shape.full) ** 3 / _DENSE_PRODUCTS

    @property
    def num_entries(self) -> int:
        return len(self.shape.row)

    @property
    def num_factor_entries(self) -> int:
        return len(self.shape.factor_row)

    def factorise(self, weight: np.ndarray, extra: np.ndarray) -> LDL:
        """The factor of H with weights ``(E,)``, and ``extra`` ``(N,)`` added to its diagonal."""
        entries = _weighted(self._slot, self.value, weight, self.shape.begin, extra[self.node])
        lower, diagonal, left = loops.factorise(self.shape, entries, self.shape.full)
        if len(left):
            root, info = torch.linalg.cholesky_ex(torch.from_numpy(left))
            if int(info):  # rounding has left no root; column by column, none is needed
                lower, diagonal, _ = loops.factorise(self.shape, entries, self.size)
            else:
                loops.put_full(self.shape, root.numpy(), lower, diagonal)
        return LDL(self, lower, diagonal)


@dataclass(frozen=True)
class LDL:
    """A factor, in the order of elimination.

    Attributes:
        pattern: of its entries.
        lower: entries of L below its diagonal of ones, column by column.
        diagonal: ``(N,)`` D.
    """

    pattern: RowPattern
    lower: np.ndarray
    diagonal: np.ndarray

    @property
    def log_det(self) -> float:
        """Log determinant of H."""
        return float(np.log(self.diagonal).sum())

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``H⁻¹ b`` for ``(N, k)`` columns."""
        pattern = self.pattern
        columns = right_hand_side.take(pattern.node, axis=0)
        loops.solve(pattern.shape, self.lower, self.diagonal, columns)
        return columns.take(pattern.rank, axis=0)

    @cached_property
    def _full(self) -> np.ndarray:
        """Z between the unknowns whose columns of L are full."""
        root = torch.from_numpy(loops.full_root(self.pattern.shape, self.lower, self.diagonal))
        return np.asarray(torch.cholesky_inverse(root).numpy())

    @cached_property
    def _inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Z's diagonal, and its entries where L has any."""
        spend(self.pattern.units)
        return loops.selected_inverse(self.pattern.shape, self.lower, self.diagonal, self._full)

    @cached_property
    def variance(self) -> np.ndarray:
        """``(N,)`` diagonal of H⁻¹."""
        return self._inverse[0].take(self.pattern.rank)

    @cached_property
    def row_variance(self) -> np.ndarray:
        """``(E,)`` j H⁻¹ jᵀ of the pattern's own rows."""
        pattern = self.pattern
        return loops.row_variance(pattern.shape, *self._inverse, pattern.column, pattern.value)

    def variance_of(self, column: np.ndarray, value: np.ndarray) -> np.ndarray:
        """``(n,)`` j H⁻¹ jᵀ of any other rows ``(n, 3)``."""
        ranked, value = self.pattern.rank[column].astype(np.int32), np.ascontiguousarray(value)
        shape, variance = self.pattern.shape, np.empty(len(value))
        near = loops.is_near(shape, ranked, value)
        if near.any():
            variance[near] = loops.row_variance(shape, *self._inverse, ranked[near], value[near])
        far = np.flatnonzero(~near)
        ends = np.unique(ranked[far][value[far] != 0])
        begin = loops.ways(shape, ends)
        if len(far) > len(ends) and begin[-1] + len(ends) * len(self._full) < _NUMBERS:
            variance[far] = self._by_ends(ends, begin, ranked[far], value[far])
            return variance
        for first in range(0, len(far), _IN_MEMORY):
            some = far[first : first + _IN_MEMORY]
            spend(len(some) * len(self.lower) / _FAR_PRODUCTS)
            before, left = loops.far_variance(shape, self.lower, self.diagonal, ranked[some], value[some])
            variance[some] = before + (product(left, self._full) * left).sum(axis=1)
        return variance

    def _by_ends(self, ends: np.ndarray, begin: np.ndarray, column: np.ndarray, value: np.ndarray) -> np.ndarray:
        """``(n,)`` j H⁻¹ jᵀ of rows that share few unknowns: each of these is followed up the tree once.

        Args:
            ends: ``(m,)`` unknowns, ascending.
            begin: ``(m + 1,)`` where the path of each begins.
            column, value: ``(n, 3)`` rows.
        """
        shape = self.pattern.shape
        spend(len(ends) * len(self.lower) / _FAR_PRODUCTS)
        way, left = loops.up_the_tree(shape, self.lower, self.diagonal, ends, begin)
        if len(self._full):
            # Where columns are full, Z = C⁻ᵀ C⁻¹: multiply the remainder by C⁻¹.
            root = torch.from_numpy(loops.full_root(shape, self.lower, self.diagonal))
            left = torch.linalg.solve_triangular(root, torch.from_numpy(left).T, upper=False).T.contiguous().numpy()
        number = np.searchsorted(ends, column)
        return loops.variance_by_ways(shape, (ends, begin, way, left), np.minimum(number, len(ends) - 1), value)


def _first_full(counts: np.ndarray) -> int:
    """The first of the full columns at the end, from numbers of entries ``(N,)``; N if they are few."""
    size = len(counts)
    lacking = np.flatnonzero(counts != np.arange(size)[::-1])
    first = int(lacking[-1]) + 1 if len(lacking) else 0
    return first if size - first >= _MANY else size


def _ties(column: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of unknowns that occur in one row."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    both = [(value[:, a] != 0) & (value[:, b] != 0) for a, b in pairs]
    first = np.concatenate([column[is_tied, a] for is_tied, (a, _) in zip(both, pairs, strict=True)])
    second = np.concatenate([column[is_tied, b] for is_tied, (_, b) in zip(both, pairs, strict=True)])
    return first, second


def _lay_out(column: np.ndarray, value: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """H's upper triangle by columns, each beginning with the diagonal; and positions of pairs of a row's unknowns."""
    begin, row, slot = _listed(column, value, size)
    return begin, row[: begin[-1]].copy(), slot.reshape(len(column), 6)


@compiled
def _listed(column: np.ndarray, value: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """The same as :func:`_lay_out`, with room to spare for rows."""
    first, free = np.zeros(size + 1, np.int64), np.empty(size, np.int64)
    for e in range(len(column)):
        for a in range(3):
            for b in range(a):
                if value[e, a] != 0 and value[e, b] != 0:
                    first[max(column[e, a], column[e, b]) + 1] += 1
    for j in range(size):
        free[j] = first[j]
        first[j + 1] += first[j]
    pair, other = np.empty(first[-1], np.int64), np.empty(first[-1], np.int32)
    for e in range(len(column)):
        for a in range(3):
            for b in range(a):
                if value[e, a] != 0 and value[e, b] != 0:
                    j = max(column[e, a], column[e, b])
                    other[free[j]] = min(column[e, a], column[e, b])
                    pair[free[j]] = 6 * e + 3 + a + b - 1
                    free[j] += 1
    begin = np.zeros(size + 1, np.int64)
    row = np.empty(first[-1] + size, np.int32)
    slot, place = np.full(6 * len(column), _NOWHERE), np.full(size, _NOWHERE)
    end = 0
    for j in range(size):
        row[end] = j
        place[j] = end
        end += 1
        for at in range(first[j], first[j + 1]):
            i = other[at]
            if place[i] < begin[j]:
                place[i] = end
                row[end] = i
                end += 1
            slot[pair[at]] = place[i]
        begin[j + 1] = end
    for e in range(len(column)):
        for a in range(3):
            if value[e, a] != 0:
                slot[6 * e + a] = begin[column[e, a]]
    return begin, row, slot


@compiled
def _weighted(
    slot: np.ndarray, value: np.ndarray, weight: np.ndarray, begin: np.ndarray, extra: np.ndarray
) -> np.ndarray:
    """Entries of H."""
    entries = np.zeros(begin[-1])
    for j in range(len(extra)):
        entries[begin[j]] = extra[j]
    for e in range(len(slot)):
        for a in range(3):
            if slot[e, a] >= 0:
                entries[slot[e, a]] += weight[e] * value[e, a] * value[e, a]
            for b in range(a):
                at = slot[e, 2 + a + b]
                if at >= 0:
                    entries[at] += weight[e] * value[e, a] * value[e, b]
    return entries
