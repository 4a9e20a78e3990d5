"""L D Lᵀ of a sparse symmetric positive definite matrix, and those entries of its inverse that tell of its own rows.

H = Jᵀ W J, rows of J with three unknowns at most. L is made row by row along the elimination tree (Liu 1990; Davis
2005).
Wherever L has an entry the inverse Z follows from those to its lower right (Takahashi, Fagan and Chin 1973; Erisman and
Tinney 1975), column j after all later ones:

    Z_ij = − Σ_k Z_ik L_kj,    Z_jj = 1 / D_j − Σ_k L_kj Z_kj,    i, k where column j of L has entries.

So what H says of each of its rows, j H⁻¹ jᵀ, is exact and costs about two factors. For any other pair of unknowns

    Z_uv = Σ_j y_j z_j / D_j,    L y = e_u,  L z = e_v,

and y has entries only on u's way up the elimination tree.

Closures that join what lies far apart leave a clique of unknowns at the end of any order, and there nearly all the
arithmetic is: L's last columns, all full, are made by a dense factor, and Z's by a dense inverse.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.algebra.sparse.sparse_factor import order_of_little_fill
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import spend

_NOWHERE = -1
# Where rounding leaves less than this of a diagonal entry, nothing is known of it but that it is positive.
_ROUNDING = 1e-15
# So many full columns are worth a dense factor.
_MANY = 100
# Products in one unit of work: of columns, of a dense factor, and of entries with rows that go up the tree.
_PRODUCTS, _DENSE_PRODUCTS, _FAR_PRODUCTS = 1e6, 2e7, 2.4e6
# So many rows go up the tree together, and so many are held.
_AT_ONCE, _IN_MEMORY = 8, 1024


class _Shape(NamedTuple):
    """Where entries stand, in the order of elimination.

    Attributes:
        begin, row: of H's upper triangle by columns, each beginning with the diagonal.
        above: ``(N,)`` what each unknown is eliminated into, or -1.
        factor_begin, factor_row: of L below its diagonal, by columns.
        full: from this column on L has all entries; N where they are too few for a dense factor.
    """

    begin: np.ndarray
    row: np.ndarray
    above: np.ndarray
    factor_begin: np.ndarray
    factor_row: np.ndarray
    full: int


class RowPattern:
    """Where H and L have entries, for rows of certain unknowns in a certain order of elimination.

    Args:
        column: ``(E, 3)`` unknowns of each row.
        value: ``(E, 3)`` J's numbers there; with 0 a row has not that unknown.
        size: N unknowns.
        rank: ``(N,)`` where each stands in the order of elimination; None: in one of little fill.

    Attributes:
        rank: likewise.
        num_entries: of H, on the diagonal and on one side of it.
        num_factor_entries: of L.
        units: of work that a factor costs, by its products; an inverse where it has entries costs as much.
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
        self.shape = _Shape(begin, row, above, factor_begin, rows, _first_full(counts))
        # As floating-point numbers: whole ones overflow in millions of unknowns.
        by_column = counts[: self.shape.full].astype(np.float64) ** 2
        self.units = float(by_column.sum()) / _PRODUCTS + float(size - self.shape.full) ** 3 / _DENSE_PRODUCTS

    @property
    def num_entries(self) -> int:
        return len(self.shape.row)

    @property
    def num_factor_entries(self) -> int:
        return len(self.shape.factor_row)

    def factorise(self, weight: np.ndarray, extra: np.ndarray) -> LDL:
        """Of H with weights ``(E,)``, and ``extra`` ``(N,)`` on its diagonal."""
        entries = _weighted(self._slot, self.value, weight, self.shape.begin, extra[self.node])
        lower, diagonal, left = _factorise(self.shape, entries, self.shape.full)
        if len(left):
            root, info = torch.linalg.cholesky_ex(torch.from_numpy(left))
            if int(info):  # rounding has left no root: column by column none is needed
                lower, diagonal, _ = _factorise(self.shape, entries, self.size)
            else:
                _put_full(self.shape, root.numpy(), lower, diagonal)
        return LDL(self, lower, diagonal)


@dataclass(frozen=True)
class LDL:
    """A factor, in the order of elimination.

    Attributes:
        pattern: where it has entries.
        lower: of L below its diagonal of ones, column by column.
        diagonal: ``(N,)`` D.
    """

    pattern: RowPattern
    lower: np.ndarray
    diagonal: np.ndarray

    @property
    def log_det(self) -> float:
        """Of H."""
        return float(np.log(self.diagonal).sum())

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``H⁻¹ b`` for ``(N, k)`` columns."""
        pattern = self.pattern
        columns = right_hand_side.take(pattern.node, axis=0)
        _solve(pattern.shape, self.lower, self.diagonal, columns)
        return columns.take(pattern.rank, axis=0)

    @cached_property
    def _full(self) -> np.ndarray:
        """Z where L's columns are full."""
        root = torch.from_numpy(_full_root(self.pattern.shape, self.lower, self.diagonal))
        return np.asarray(torch.cholesky_inverse(root).numpy())

    @cached_property
    def _inverse(self) -> tuple[np.ndarray, np.ndarray]:
        """Z's diagonal, and its entries where L has any."""
        spend(self.pattern.units)
        return _selected_inverse(self.pattern.shape, self.lower, self.diagonal, self._full)

    @cached_property
    def variance(self) -> np.ndarray:
        """``(N,)`` diagonal of H⁻¹."""
        return self._inverse[0].take(self.pattern.rank)

    @cached_property
    def row_variance(self) -> np.ndarray:
        """``(E,)`` j H⁻¹ jᵀ of the pattern's own rows."""
        pattern = self.pattern
        return _row_variance(pattern.shape, *self._inverse, pattern.column, pattern.value)

    def variance_of(self, column: np.ndarray, value: np.ndarray) -> np.ndarray:
        """``(n,)`` j H⁻¹ jᵀ of any other rows ``(n, 3)``."""
        ranked, value = self.pattern.rank[column].astype(np.int32), np.ascontiguousarray(value)
        shape, variance = self.pattern.shape, np.empty(len(value))
        near = _is_near(shape, ranked, value)
        if near.any():
            variance[near] = _row_variance(shape, *self._inverse, ranked[near], value[near])
        far = np.flatnonzero(~near)
        for first in range(0, len(far), _IN_MEMORY):
            some = far[first : first + _IN_MEMORY]
            spend(len(some) * len(self.lower) / _FAR_PRODUCTS)
            before, left = _far_variance(shape, self.lower, self.diagonal, ranked[some], value[some])
            variance[some] = before + (product(left, self._full) * left).sum(axis=1)
        return variance


def _first_full(counts: np.ndarray) -> int:
    """The first of the last columns that are full, by numbers of entries ``(N,)``; N where they are few."""
    size = len(counts)
    lacking = np.flatnonzero(counts != np.arange(size)[::-1])
    first = int(lacking[-1]) + 1 if len(lacking) else 0
    return first if size - first >= _MANY else size


def _ties(column: np.ndarray, value: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Pairs of unknowns that some row has both."""
    pairs = [(0, 1), (0, 2), (1, 2)]
    both = [(value[:, a] != 0) & (value[:, b] != 0) for a, b in pairs]
    first = np.concatenate([column[is_tied, a] for is_tied, (a, _) in zip(both, pairs, strict=True)])
    second = np.concatenate([column[is_tied, b] for is_tied, (_, b) in zip(both, pairs, strict=True)])
    return first, second


@compiled
def _lay_out(column: np.ndarray, value: np.ndarray, size: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """H's upper triangle by columns, each beginning with the diagonal; and where pairs of a row's unknowns stand."""
    count = np.zeros(size + 1, np.int64)
    for e in range(len(column)):
        for a in range(3):
            for b in range(a):
                if value[e, a] != 0 and value[e, b] != 0:
                    count[max(column[e, a], column[e, b]) + 1] += 1
    first = np.cumsum(count)
    pair, other = np.empty(first[-1], np.int64), np.empty(first[-1], np.int32)
    free = first[:-1].copy()
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
    slot = np.full(6 * len(column), _NOWHERE, np.int64)
    place = np.full(size, _NOWHERE, np.int64)
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
    return begin, row[:end].copy(), slot.reshape(len(column), 6)


@compiled
def _weighted(
    slot: np.ndarray, value: np.ndarray, weight: np.ndarray, begin: np.ndarray, extra: np.ndarray
) -> np.ndarray:
    """H's numbers."""
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


@compiled
def elimination_tree(begin: np.ndarray, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """What each unknown is eliminated into, and how many entries each column of L has below its diagonal.

    Args:
        begin, row: of the matrix's upper triangle by columns, in the order of elimination.
    """
    size = len(begin) - 1
    above, seen = np.full(size, _NOWHERE, np.int32), np.empty(size, np.int32)
    count = np.zeros(size, np.int64)
    for k in range(size):
        seen[k] = k
        for at in range(begin[k], begin[k + 1]):
            i = row[at]
            while seen[i] != k:
                if above[i] == _NOWHERE:
                    above[i] = k
                count[i] += 1
                seen[i] = k
                i = above[i]
    return above, count


@compiled
def factor_rows(begin: np.ndarray, row: np.ndarray, above: np.ndarray, factor_begin: np.ndarray) -> np.ndarray:
    """Rows of L's entries, ascending in each column."""
    size = len(above)
    factor_row, free = np.empty(factor_begin[-1], np.int32), factor_begin[:-1].copy()
    seen = np.empty(size, np.int32)
    for k in range(size):
        seen[k] = k
        for at in range(begin[k], begin[k + 1]):
            i = row[at]
            while seen[i] != k:
                factor_row[free[i]] = k
                free[i] += 1
                seen[i] = k
                i = above[i]
    return factor_row


@compiled
def _factorise(shape: _Shape, entries: np.ndarray, full: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L's numbers and D before column ``full``, of H's numbers, and what is left of H from there on, its lower half."""
    begin, row, above, factor_begin, factor_row, _ = shape
    size = len(above)
    lower, diagonal = np.empty(len(factor_row)), np.empty(size)
    remaining = np.zeros((size - full, size - full))
    free = factor_begin[:-1].copy()
    # Row k of L solves L₁ D₁ l = h for the rows before; it has entries on ways up the tree alone, in that order.
    work, seen = np.zeros(size), np.empty(size, np.int32)
    way, waiting = np.empty(size, np.int32), np.empty(size, np.int32)
    for k in range(size):
        seen[k] = k
        top = size
        for at in range(begin[k], begin[k + 1]):
            i = row[at]
            work[i] += entries[at]
            count = 0
            while seen[i] != k:
                waiting[count] = i
                count += 1
                seen[i] = k
                i = above[i]
            while count > 0:
                count -= 1
                top -= 1
                way[top] = waiting[count]
        pivot = work[k]
        work[k] = 0.0
        for place in range(top, size):
            i = way[place]
            left = work[i]
            work[i] = 0.0
            if i >= full:
                remaining[k - full, i - full] = left
                continue
            for at in range(factor_begin[i], free[i]):
                work[factor_row[at]] -= lower[at] * left
            ratio = left / diagonal[i]
            pivot -= ratio * left
            lower[free[i]] = ratio
            free[i] += 1
        if k >= full:
            remaining[k - full, k - full] = pivot
        diagonal[k] = max(pivot, _ROUNDING * entries[begin[k]])
    return lower, diagonal, remaining


@compiled
def _put_full(shape: _Shape, root: np.ndarray, lower: np.ndarray, diagonal: np.ndarray) -> None:
    """L and D where columns are full, of a root C with C Cᵀ = L D Lᵀ."""
    _, _, _, factor_begin, _, full = shape
    for j in range(len(root)):
        diagonal[full + j] = root[j, j] ** 2
        first = factor_begin[full + j] - j - 1
        for i in range(j + 1, len(root)):
            lower[first + i] = root[i, j] / root[j, j]


@compiled
def _full_root(shape: _Shape, lower: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """That root."""
    _, _, above, factor_begin, _, full = shape
    size = len(above) - full
    root = np.zeros((size, size))
    for j in range(size):
        root[j, j] = np.sqrt(diagonal[full + j])
        first = factor_begin[full + j] - j - 1
        for i in range(j + 1, size):
            root[i, j] = lower[first + i] * root[j, j]
    return root


@compiled
def _solve(shape: _Shape, lower: np.ndarray, diagonal: np.ndarray, columns: np.ndarray) -> None:
    """``(N, k)`` columns in place."""
    _, _, _, factor_begin, factor_row, _ = shape
    size, width = columns.shape
    for j in range(size):
        for at in range(factor_begin[j], factor_begin[j + 1]):
            i, factor = factor_row[at], lower[at]
            for c in range(width):
                columns[i, c] -= factor * columns[j, c]
    for j in range(size - 1, -1, -1):
        for c in range(width):
            columns[j, c] /= diagonal[j]
        for at in range(factor_begin[j], factor_begin[j + 1]):
            i, factor = factor_row[at], lower[at]
            for c in range(width):
                columns[j, c] -= factor * columns[i, c]


@compiled
def _selected_inverse(
    shape: _Shape, lower: np.ndarray, diagonal: np.ndarray, whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Z's diagonal and its entries where L has any, of the ``whole`` of it where columns are full."""
    _, _, _, factor_begin, factor_row, full = shape
    size = len(diagonal)
    own, inverse = np.empty(size), np.empty(len(lower))
    place, total = np.full(size, _NOWHERE, np.int64), np.empty(size)
    for j in range(full, size):
        own[j] = whole[j - full, j - full]
        for at in range(factor_begin[j], factor_begin[j + 1]):
            inverse[at] = whole[factor_row[at] - full, j - full]
    for j in range(full - 1, -1, -1):
        first, end = factor_begin[j], factor_begin[j + 1]
        for at in range(first, end):
            place[factor_row[at]] = at - first
            total[at - first] = 0.0
        for at in range(first, end):
            k, factor = factor_row[at], lower[at]
            so_far = total[at - first] - factor * own[k]
            if k >= full:
                for other in range(at + 1, end):
                    value = whole[factor_row[other] - full, k - full]
                    total[other - first] -= factor * value
                    so_far -= lower[other] * value
            else:
                # The rows of column j from k on are among those of column k.
                for other in range(factor_begin[k], factor_begin[k + 1]):
                    to = place[factor_row[other]]
                    if to >= 0:
                        total[to] -= factor * inverse[other]
                        so_far -= lower[first + to] * inverse[other]
            total[at - first] = so_far
        left = 1 / diagonal[j]
        for at in range(first, end):
            inverse[at] = total[at - first]
            left -= lower[at] * inverse[at]
            place[factor_row[at]] = _NOWHERE
        own[j] = left
    return own, inverse


@compiled
def _is_near(shape: _Shape, column: np.ndarray, value: np.ndarray) -> np.ndarray:
    """``(n,)`` whether all pairs of a row's unknowns are entries of L."""
    _, _, _, factor_begin, factor_row, _ = shape
    near = np.ones(len(column), np.bool_)
    for e in range(len(column)):
        for a in range(3):
            for b in range(a):
                if value[e, a] != 0 and value[e, b] != 0:
                    i, j = max(column[e, a], column[e, b]), min(column[e, a], column[e, b])
                    first, end = factor_begin[j], factor_begin[j + 1]
                    at = first + np.searchsorted(factor_row[first:end], i)
                    if at == end or factor_row[at] != i:
                        near[e] = False
    return near


@compiled
def _row_variance(
    shape: _Shape, own: np.ndarray, inverse: np.ndarray, column: np.ndarray, value: np.ndarray
) -> np.ndarray:
    """Values j Z jᵀ of rows whose pairs of unknowns all are entries of L."""
    _, _, _, factor_begin, factor_row, _ = shape
    variance = np.empty(len(column))
    for e in range(len(column)):
        total = 0.0
        for a in range(3):
            if value[e, a] == 0:
                continue
            total += value[e, a] * value[e, a] * own[column[e, a]]
            for b in range(a):
                if value[e, b] != 0:
                    i, j = max(column[e, a], column[e, b]), min(column[e, a], column[e, b])
                    at = factor_begin[j] + np.searchsorted(factor_row[factor_begin[j] : factor_begin[j + 1]], i)
                    total += 2 * value[e, a] * value[e, b] * inverse[at]
        variance[e] = total
    return variance


@compiled
def _far_variance(
    shape: _Shape, lower: np.ndarray, diagonal: np.ndarray, column: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values j Z jᵀ of any rows: squares of L⁻¹ jᵀ over D, along the ways up the tree of a row's unknowns.

    Only as far as columns are not full; and what is left of jᵀ there, ``(n, N - full)``, between which Z stands.
    """
    _, _, above, factor_begin, factor_row, full = shape
    size = len(above)
    variance, work = np.zeros(len(column)), np.zeros((size, _AT_ONCE))
    way, seen = np.empty(size, np.int64), np.full(size, _NOWHERE, np.int64)
    left, remaining = np.empty(_AT_ONCE), np.empty((len(column), size - full))
    for first in range(0, len(column), _AT_ONCE):
        last, count = min(first + _AT_ONCE, len(column)), 0
        for e in range(first, last):
            for a in range(3):
                j = column[e, a]
                if value[e, a] != 0:
                    work[j, e - first] += value[e, a]
                    while j != _NOWHERE and j < full and seen[j] != first:
                        seen[j] = first
                        way[count] = j
                        count += 1
                        j = above[j]
        # What comes later in the order leads back to nothing that was before.
        for j in np.sort(way[:count]):
            for c in range(_AT_ONCE):
                left[c] = work[j, c]
                work[j, c] = 0.0
            for e in range(first, last):
                variance[e] += left[e - first] * left[e - first] / diagonal[j]
            for at in range(factor_begin[j], factor_begin[j + 1]):
                i, factor = factor_row[at], lower[at]
                for c in range(_AT_ONCE):
                    work[i, c] -= factor * left[c]
        for e in range(first, last):
            for j in range(full, size):
                remaining[e, j - full] = work[j, e - first]
                work[j, e - first] = 0.0
    return variance, remaining
