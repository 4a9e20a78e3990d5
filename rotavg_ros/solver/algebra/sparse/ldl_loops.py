"""Loops over L's entries: the factor, solves with its triangles, and the inverse at L's entries.

The formulas are in :mod:`~rotavg_ros.solver.algebra.sparse.ldl`.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

_NOWHERE = -1
# Smallest pivot, as a share of the diagonal entry: where rounding leaves less, only the sign is known.
_ROUNDING = 1e-15
# Rows that are followed up the tree together.
_AT_ONCE = 8


class Shape(NamedTuple):
    """Positions of entries, in the order of elimination.

    Attributes:
        begin, row: H's upper triangle by columns, each beginning with the diagonal.
        above: ``(N,)`` parent of each unknown in the elimination tree, or -1.
        factor_begin, factor_row: L below its diagonal, by columns.
        full: from this column on, L has all entries; N if such columns are too few for a dense factor.
    """

    begin: np.ndarray
    row: np.ndarray
    above: np.ndarray
    factor_begin: np.ndarray
    factor_row: np.ndarray
    full: int


@compiled
def factorise(shape: Shape, entries: np.ndarray, full: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """L and D before column ``full``, from H's entries; and the lower half of what is left of H from there on."""
    begin, row, above, factor_begin, factor_row, _ = shape
    size = len(above)
    lower, diagonal = np.empty(len(factor_row)), np.empty(size)
    remaining = np.zeros((size - full, size - full))
    # Row k of L solves L₁ D₁ l = h with the rows before it; it has entries only on paths up the tree, in that order.
    work, seen = np.zeros(size), np.empty(size, np.int32)
    way, waiting, free = np.empty(size, np.int32), np.empty(size, np.int32), np.empty(size, np.int64)
    for k in range(size):
        seen[k], free[k] = k, factor_begin[k]
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
def put_full(shape: Shape, root: np.ndarray, lower: np.ndarray, diagonal: np.ndarray) -> None:
    """Fill L and D where columns are full, from a root C with C Cᵀ = L D Lᵀ."""
    _, _, _, factor_begin, _, full = shape
    for j in range(len(root)):
        diagonal[full + j] = root[j, j] ** 2
        first = factor_begin[full + j] - j - 1
        for i in range(j + 1, len(root)):
            lower[first + i] = root[i, j] / root[j, j]


@compiled
def full_root(shape: Shape, lower: np.ndarray, diagonal: np.ndarray) -> np.ndarray:
    """The root C of :func:`put_full`."""
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
def solve(shape: Shape, lower: np.ndarray, diagonal: np.ndarray, columns: np.ndarray) -> None:
    """Solve for ``(N, k)`` columns in place."""
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
def selected_inverse(
    shape: Shape, lower: np.ndarray, diagonal: np.ndarray, whole: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Z's diagonal, and Z at L's entries, given the ``whole`` of Z where columns are full."""
    _, _, _, factor_begin, factor_row, full = shape
    size = len(diagonal)
    own, inverse = np.empty(size), np.empty(len(lower))
    place, total = np.full(size, _NOWHERE), np.empty(size)
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
def _first_from(row: np.ndarray, begin: int, end: int, least: int) -> int:
    """The first of these positions whose row, ascending, is not less than ``least``; ``end`` if there is none."""
    while begin < end:
        middle = (begin + end) // 2
        if row[middle] < least:
            begin = middle + 1
        else:
            end = middle
    return begin


@compiled
def is_near(shape: Shape, column: np.ndarray, value: np.ndarray) -> np.ndarray:
    """``(n,)`` bool, whether all pairs of a row's unknowns are entries of L."""
    _, _, _, factor_begin, factor_row, _ = shape
    near = np.empty(len(column), np.bool_)
    for e in range(len(column)):
        near[e] = True
        for a in range(3):
            for b in range(a):
                if value[e, a] != 0 and value[e, b] != 0:
                    i, j = max(column[e, a], column[e, b]), min(column[e, a], column[e, b])
                    at = _first_from(factor_row, factor_begin[j], factor_begin[j + 1], i)
                    if at == factor_begin[j + 1] or factor_row[at] != i:
                        near[e] = False
    return near


@compiled
def row_variance(
    shape: Shape, own: np.ndarray, inverse: np.ndarray, column: np.ndarray, value: np.ndarray
) -> np.ndarray:
    """Values j Z jᵀ of rows whose pairs of unknowns are all entries of L."""
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
                    at = _first_from(factor_row, factor_begin[j], factor_begin[j + 1], i)
                    total += 2 * value[e, a] * value[e, b] * inverse[at]
        variance[e] = total
    return variance


@compiled
def far_variance(
    shape: Shape, lower: np.ndarray, diagonal: np.ndarray, column: np.ndarray, value: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Values j Z jᵀ of any rows: squares of L⁻¹ jᵀ over D, along the paths of a row's unknowns up the tree.

    They sum over columns that are not full. The second result is the remainder ``(n, N - full)`` of jᵀ in the full
    ones, between which Z is known.
    """
    _, _, above, factor_begin, factor_row, full = shape
    size = len(above)
    variance, work = np.zeros(len(column)), np.zeros((size, _AT_ONCE))
    way, path, seen = np.empty(size, np.int64), np.empty(size, np.int64), np.full(size, _NOWHERE)
    left, remaining = np.empty(_AT_ONCE), np.empty((len(column), size - full))
    for first in range(0, len(column), _AT_ONCE):
        last, count = min(first + _AT_ONCE, len(column)), 0
        for e in range(first, last):
            for a in range(3):
                j = column[e, a]
                if value[e, a] != 0:
                    work[j, e - first] += value[e, a]
                    length = 0
                    while j != _NOWHERE and j < full and seen[j] != first:
                        seen[j] = first
                        path[length] = j
                        length += 1
                        j = above[j]
                    count += length
                    _merge_in(path[:length], way[:count])
        # What comes later in the order never leads back to what was before.
        for place in range(count):
            j = way[place]
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


@compiled
def _merge_in(path: np.ndarray, way: np.ndarray) -> None:
    """Merge a path, ascending, into ``way``, ascending, which has room for it at the end."""
    last, to = len(path) - 1, len(way) - 1
    while last >= 0:
        before = to - last - 1
        if before >= 0 and way[before] > path[last]:
            way[to] = way[before]
        else:
            way[to] = path[last]
            last -= 1
        to -= 1


@compiled
def ways(shape: Shape, ends: np.ndarray) -> np.ndarray:
    """``(m + 1,)`` where each path up the tree begins if all are stored in a row, each up to the full columns."""
    begin = np.zeros(len(ends) + 1, np.int64)
    for e in range(len(ends)):
        j, count = ends[e], 0
        while j != _NOWHERE and j < shape.full:
            count += 1
            j = shape.above[j]
        begin[e + 1] = begin[e] + count
    return begin


@compiled
def up_the_tree(
    shape: Shape, lower: np.ndarray, diagonal: np.ndarray, ends: np.ndarray, begin: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """D^-½ L⁻¹ of single unknowns along their paths; and the remainder where columns are full, ``(m, N - full)``."""
    _, _, above, factor_begin, factor_row, full = shape
    work, way = np.zeros(len(above)), np.empty(begin[-1])
    remaining = np.empty((len(ends), len(above) - full))
    for e in range(len(ends)):
        j = ends[e]
        work[j] = 1.0
        for place in range(begin[e], begin[e + 1]):
            left = work[j]
            work[j] = 0.0
            way[place] = left / np.sqrt(diagonal[j])
            for at in range(factor_begin[j], factor_begin[j + 1]):
                work[factor_row[at]] -= lower[at] * left
            j = above[j]
        for i in range(full, len(above)):
            remaining[e, i - full] = work[i]
            work[i] = 0.0
    return way, remaining


@compiled
def variance_by_ways(
    shape: Shape,
    of_ends: tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray],
    number: np.ndarray,
    value: np.ndarray,
) -> np.ndarray:
    """Values j Z jᵀ of rows ``(n, 3)`` from the paths of :func:`up_the_tree`: paths that have met stay together."""
    ends, begin, way, left = of_ends
    variance = np.empty(len(number))
    for n in range(len(number)):
        total = 0.0
        for a in range(3):
            if value[n, a] == 0:
                continue
            for b in range(a + 1):
                if value[n, b] == 0:
                    continue
                u, v = number[n, a], number[n, b]
                i, j = ends[u], ends[v]
                one, other = begin[u], begin[v]
                while one < begin[u + 1] and other < begin[v + 1] and i != j:
                    if i < j:
                        i = shape.above[i]
                        one += 1
                    else:
                        j = shape.above[j]
                        other += 1
                together = 0.0
                if i == j:
                    for step in range(begin[u + 1] - one):
                        together += way[one + step] * way[other + step]
                for at in range(left.shape[1]):
                    together += left[u, at] * left[v, at]
                total += value[n, a] * value[n, b] * together * (1 if a == b else 2)
        variance[n] = total
    return variance
