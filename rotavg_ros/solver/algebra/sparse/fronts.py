"""Loops over small fronts: Cholesky's factor Uᵀ U, solves with its triangles, and the inverse's entries within fronts.

Of a front's matrix, pivots against pivots and rows, only the upper triangle is kept. What elimination leaves between
its rows waits on a stack for the parent front. Downwards, a front finds there the inverse between its rows (Takahashi,
Fagan and Chin 1973; by fronts, Campbell and Davis 1995).
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.sparse.elimination import Shape

# Smallest pivot, as a share of the diagonal entry: where rounding leaves less, only the sign is known.
_ROUNDING = 1e-15


class Room(NamedTuple):
    """Arrays that fronts read and fill.

    Attributes:
        entries: the matrix's entries, or those of the inverse at the same positions.
        store: the factor's entries.
        stack: what waits for parents, or for children.
        work: room for one front.
    """

    entries: np.ndarray
    store: np.ndarray
    stack: np.ndarray
    work: np.ndarray


@compiled
def _own(shape: Shape, f: int, store: np.ndarray) -> np.ndarray:
    """``(p, p + r)`` a front's part of the factor, pivots against pivots and rows."""
    num_pivots = shape.begin[f + 1] - shape.begin[f]
    width = num_pivots + shape.row_begin[f + 1] - shape.row_begin[f]
    kept: np.ndarray = store[shape.store[f] : shape.store[f] + num_pivots * width].reshape(num_pivots, width)
    return kept


@compiled
def gather(shape: Shape, f: int, room: Room, own: np.ndarray, left: np.ndarray, top: int) -> int:
    """Sum the matrix's entries and what children leave into a front: ``own`` ``(p, p + r)``, ``left`` ``(r, r)``.

    Returns:
        The size of the stack, in numbers.
    """
    flat = own.reshape(-1)
    flat[:] = 0.0
    left[:] = 0.0
    for e in range(shape.entry_begin[f], shape.entry_begin[f + 1]):
        flat[shape.entry[e]] = room.entries[e]
    num_pivots = len(own)
    for at in range(shape.child_begin[f + 1] - 1, shape.child_begin[f] - 1, -1):
        child = shape.child[at]
        within = shape.within[shape.row_begin[child] : shape.row_begin[child + 1]]
        count = len(within)
        top -= count * count
        for i in range(count):
            line = room.stack[top + i * count : top + (i + 1) * count]
            if within[i] < num_pivots:
                to = own[within[i]]
                for j in range(i, count):
                    to[within[j]] += line[j]
            else:
                to = left[within[i] - num_pivots]
                for j in range(i, count):
                    to[within[j] - num_pivots] += line[j]
    return top


@compiled
def _diagonal(shape: Shape, f: int, entries: np.ndarray, width: int) -> np.ndarray:
    """``(p,)`` the matrix's own diagonal entries of a front's pivots."""
    diagonal = np.zeros(shape.begin[f + 1] - shape.begin[f])
    for e in range(shape.entry_begin[f], shape.entry_begin[f + 1]):
        if shape.entry[e] % (width + 1) == 0:
            diagonal[shape.entry[e] // (width + 1)] = entries[e]
    return diagonal


@compiled
def _take(to: np.ndarray, of: np.ndarray, row: int, first: int, last: int) -> None:
    """Subtract what pivots ``first`` … ``last`` - 1 of ``of`` contribute at ``row`` from ``to``, the end of a line."""
    end = of.shape[1]
    begin, k = end - len(to), first
    while k + 4 <= last:
        a, b, c, d = of[k, row], of[k + 1, row], of[k + 2, row], of[k + 3, row]
        one, two, three, four = of[k, begin:end], of[k + 1, begin:end], of[k + 2, begin:end], of[k + 3, begin:end]
        for i in range(end - begin):
            to[i] -= a * one[i] + b * two[i] + c * three[i] + d * four[i]
        k += 4
    while k < last:
        a, one = of[k, row], of[k, begin:end]
        for i in range(end - begin):
            to[i] -= a * one[i]
        k += 1


@compiled
def eliminate(shape: Shape, first: int, last: int, room: Room, top: int) -> int:
    """Eliminate fronts ``first`` … ``last`` - 1.

    Returns:
        The size of the stack, in numbers; -1: the matrix is not positive definite.
    """
    for f in range(first, last):
        own = _own(shape, f, room.store)
        num_pivots, width = own.shape
        num_rows = width - num_pivots
        left = room.work[: num_rows * num_rows].reshape(num_rows, num_rows)
        top = gather(shape, f, room, own, left, top)
        scale = _diagonal(shape, f, room.entries, width)
        for begin in range(0, num_pivots, 4):
            end = min(begin + 4, num_pivots)
            for k in range(begin, end):
                _take(own[k, k:], own, k, begin, k)
                least = _ROUNDING * scale[k]
                if own[k, k] < least:
                    # What is left beside it is rounding, too; divided by so small a root it would grow.
                    own[k, k], own[k, k + 1 :] = least, 0.0
                if not own[k, k] > 0.0:
                    return -1
                root = np.sqrt(own[k, k])
                own[k, k] = root
                for i in range(k + 1, width):
                    own[k, i] /= root
            for k in range(end, num_pivots):
                _take(own[k, k:], own, k, begin, end)
            for i in range(num_rows):
                _take(left[i, i:], own, num_pivots + i, begin, end)
        for i in range(num_rows * num_rows):
            room.stack[top + i] = room.work[i]
        top += num_rows * num_rows
    return top


@compiled
def solve_lower(shape: Shape, first: int, last: int, store: np.ndarray, columns: np.ndarray) -> None:
    """Apply U⁻ᵀ to columns ``(N, n)`` in place, by fronts ``first`` … ``last`` - 1."""
    num_columns = columns.shape[1]
    for f in range(first, last):
        start, row = shape.begin[f], shape.row[shape.row_begin[f] : shape.row_begin[f + 1]]
        own = _own(shape, f, store)
        num_pivots, width = own.shape
        value = np.empty(width)
        for c in range(num_columns):
            asked = 0
            while asked < num_pivots and columns[start + asked, c] == 0.0:
                asked += 1
            if asked == num_pivots:
                continue
            for k in range(num_pivots):
                value[k] = columns[start + k, c]
            value[num_pivots:] = 0.0
            for k in range(asked, num_pivots):
                value[k] /= own[k, k]
                factor, line = value[k], own[k]
                for i in range(k + 1, width):
                    value[i] -= factor * line[i]
            for k in range(asked, num_pivots):
                columns[start + k, c] = value[k]
            for i in range(len(row)):
                columns[row[i], c] += value[num_pivots + i]


@compiled
def solve_upper(shape: Shape, first: int, last: int, store: np.ndarray, columns: np.ndarray) -> None:
    """Apply U⁻¹ to columns ``(N, n)`` in place, by fronts ``last`` - 1 … ``first``."""
    num_columns = columns.shape[1]
    for f in range(last - 1, first - 1, -1):
        start, row = shape.begin[f], shape.row[shape.row_begin[f] : shape.row_begin[f + 1]]
        own = _own(shape, f, store)
        num_pivots, width = own.shape
        value = np.empty(width)
        for c in range(num_columns):
            for i in range(len(row)):
                value[num_pivots + i] = columns[row[i], c]
            last = num_pivots
            while last >= 4:
                # Four rows at once: what is known is read once for all of them.
                one, two, three, four = own[last - 1], own[last - 2], own[last - 3], own[last - 4]
                a, b, left, right = 0.0, 0.0, 0.0, 0.0
                for i in range(last, width):
                    known = value[i]
                    a += one[i] * known
                    b += two[i] * known
                    left += three[i] * known
                    right += four[i] * known
                end = start + last
                last_of_four = (columns[end - 1, c] - a) / one[last - 1]
                b += two[last - 1] * last_of_four
                second = (columns[end - 2, c] - b) / two[last - 2]
                left += three[last - 1] * last_of_four + three[last - 2] * second
                third = (columns[end - 3, c] - left) / three[last - 3]
                right += four[last - 1] * last_of_four + four[last - 2] * second + four[last - 3] * third
                value[last - 1], value[last - 2], value[last - 3] = last_of_four, second, third
                value[last - 4] = (columns[end - 4, c] - right) / four[last - 4]
                last -= 4
            for k in range(last - 1, -1, -1):
                line, total = own[k], 0.0
                for i in range(k + 1, width):
                    total += line[i] * value[i]
                value[k] = (columns[start + k, c] - total) / line[k]
            for k in range(num_pivots):
                columns[start + k, c] = value[k]


@compiled
def invert(shape: Shape, first: int, last: int, room: Room, top: int) -> int:
    """Entries of the inverse Z at the positions of the matrix's entries, by fronts ``last`` - 1 … ``first``.

    Where j is a pivot and i > j,  Z_ij = − Σ_k U_jk Z_ki / U_jj,  k > j;  Z_jj = (1 / U_jj − Σ_k U_jk Z_kj) / U_jj.

    Returns:
        The size of the stack, in numbers.
    """
    for f in range(last - 1, first - 1, -1):
        own = _own(shape, f, room.store)
        num_pivots, width = own.shape
        num_rows = width - num_pivots
        found = room.work[: width * width].reshape(width, width)
        top -= num_rows * num_rows
        for i in range(num_rows):
            for j in range(num_rows):
                found[num_pivots + i, num_pivots + j] = room.stack[top + i * num_rows + j]
        for j in range(num_pivots - 1, -1, -1):
            line, to = own[j], found[j, j + 1 :]
            to[:] = 0.0
            k = j + 1
            while k + 4 <= width:
                a, b, c, d = line[k], line[k + 1], line[k + 2], line[k + 3]
                one, two, three, four = (
                    found[k, j + 1 :],
                    found[k + 1, j + 1 :],
                    found[k + 2, j + 1 :],
                    found[k + 3, j + 1 :],
                )
                for i in range(width - j - 1):
                    to[i] -= a * one[i] + b * two[i] + c * three[i] + d * four[i]
                k += 4
            while k < width:
                a, one = line[k], found[k, j + 1 :]
                for i in range(width - j - 1):
                    to[i] -= a * one[i]
                k += 1
            own_part = 1.0 / line[j]
            for i in range(j + 1, width):
                found[j, i] /= line[j]
                found[i, j] = found[j, i]
                own_part -= line[i] * found[j, i]
            found[j, j] = own_part / line[j]
        top = hand_down(shape, f, found, room, top)
    return top


@compiled
def hand_down(shape: Shape, f: int, found: np.ndarray, room: Room, top: int) -> int:
    """Pass a front's part of Z ``(p + r, p + r)`` to its children, and store it at the matrix's entries.

    Returns:
        The size of the stack, in numbers.
    """
    flat = found.reshape(-1)  # its first rows are those of the pivots
    for e in range(shape.entry_begin[f], shape.entry_begin[f + 1]):
        room.entries[e] = flat[shape.entry[e]]
    for at in range(shape.child_begin[f], shape.child_begin[f + 1]):
        child = shape.child[at]
        within = shape.within[shape.row_begin[child] : shape.row_begin[child + 1]]
        for i in within:
            line = found[i]
            for j in within:
                room.stack[top] = line[j]
                top += 1
    return top
