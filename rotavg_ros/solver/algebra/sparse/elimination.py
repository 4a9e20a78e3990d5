"""In which order, and in which dense fronts, a sparse symmetric matrix of blocks is eliminated.

Blocks are eliminated in an order of little fill. A front is a run of them, its pivots, and the later blocks that these
are tied to, its rows (Duff and Reid 1983; Liu 1992). What elimination leaves of the rows goes to the front above, each
front's children being those that leave theirs to it. Children come right before it, so what is left waits on a stack.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.sparse.ldl import elimination_tree, factor_rows
from rotavg_ros.solver.algebra.sparse.sparse_factor import order_of_little_fill
from rotavg_ros.solver.running.work import rest

# What a front takes besides its arithmetic, seconds; numbers multiplied and moved a second, on one core of 2020. They
# decide on merging and are what work is counted in; no answer depends on them.
_FRONT_S, _PRODUCTS_PER_S, _MOVES_PER_S = 1.5e-6, 3e9, 5e8
# Where products are as many as this, those of whole matrices take less, and so many are made a second.
_DENSE, _DENSE_PER_S = 4e5, 2.5e10
# Seconds to a unit: as long as one takes of a solve by rotations alone, with all that is done around it.
_UNIT_S = 5e-4
# A solve may rest after so many seconds.
_REST_S = 1e-3
_NOWHERE = -1
# What begins a matrix of its own lies at a multiple of so many numbers: products come out alike to the last bit.
_ALIGNED = 8


class Shape(NamedTuple):
    """Where fronts stand, in single unknowns in the order of elimination, F fronts.

    Attributes:
        begin: ``(F + 1,)`` first pivot of each.
        row_begin, row: ``(F + 1,)`` and the later unknowns that each front's pivots are tied to, ascending.
        within: where each of these stands in the front above, among its pivots and then its rows.
        child_begin, child: ``(F + 1,)`` and the fronts that leave their rows to each, ascending.
        store: ``(F + 1,)`` where each front's pivots are kept, against these and its rows.
        entry_begin, entry: ``(F + 1,)`` and where in that the matrix's own numbers stand.
    """

    begin: np.ndarray
    row_begin: np.ndarray
    row: np.ndarray
    within: np.ndarray
    child_begin: np.ndarray
    child: np.ndarray
    store: np.ndarray
    entry_begin: np.ndarray
    entry: np.ndarray


@dataclass(frozen=True)
class Stretch:
    """Fronts that are eliminated without a rest.

    Attributes:
        first, last: of them, the last not included.
        is_dense: one front so large that products of whole matrices take less.
        units: of work that they take.
    """

    first: int
    last: int
    is_dense: bool
    units: float


class Elimination:
    """The order and the fronts of a pattern of blocks.

    Args:
        first, second: ``(E,)`` each, blocks that are tied, in any order and as often as it comes.
        num_blocks: B.
        size: d, unknowns of a block.

    Attributes:
        rank: ``(B,)`` where each block stands in the order.
        shape: where the fronts stand.
        stretches: of fronts, in order.
        num_entries: numbers of the matrix, see :meth:`places`.
        num_waiting: numbers that wait on the stack at most, upwards and downwards.
        most_rows, most_unknowns: of any front.
        units: of work that it takes.
    """

    def __init__(self, first: np.ndarray, second: np.ndarray, num_blocks: int, size: int) -> None:
        self.num_blocks, self.size = num_blocks, size
        order = order_of_little_fill(first, second, num_blocks)
        rest()
        begin, row = _upper(order[first], order[second], num_blocks)
        above, counts = elimination_tree(begin, row)
        factor_begin = np.append(0, np.cumsum(counts))
        factor_row = factor_rows(begin, row, above, factor_begin)
        rest()
        fronts = _Fronts(*_merged(above, counts, factor_begin, factor_row, size))
        self.rank = fronts.place[order]
        rest()
        lower, upper = np.minimum(self.rank[first], self.rank[second]), np.maximum(self.rank[first], self.rank[second])
        self._lay_out(fronts, lower, upper)

    def _lay_out(self, fronts: _Fronts, lower: np.ndarray, upper: np.ndarray) -> None:
        """All of it in single unknowns, with places for what ties blocks ``lower`` ≤ ``upper`` ``(E,)`` or itself."""
        d, num_blocks, diagonal = self.size, self.num_blocks, np.arange(self.num_blocks)
        pivots, rows = np.diff(fronts.begin), np.diff(fronts.row_begin)
        width = pivots + rows
        room = -(-d * d * pivots * width // _ALIGNED) * _ALIGNED
        child_begin = np.append(0, np.cumsum(np.bincount(fronts.above + 1, minlength=len(pivots) + 1)[1:]))
        child = np.argsort(fronts.above, kind="stable")[np.count_nonzero(fronts.above < 0) :]
        self._ties = np.unique(np.concatenate((lower * num_blocks + upper, diagonal * num_blocks + diagonal)))
        lower, upper = self._ties // num_blocks, self._ties % num_blocks
        front = np.searchsorted(fronts.begin, lower, side="right") - 1
        # Ascending, so that where a block stands among a front's rows can be looked up.
        key = np.repeat(np.arange(len(rows)), rows) * num_blocks + fronts.row
        among = np.searchsorted(key, front * num_blocks + upper) - fronts.row_begin[front]
        is_pivot = upper < fronts.begin[front + 1]
        column = d * np.where(is_pivot, upper - fronts.begin[front], pivots[front] + among)
        inside, line = np.arange(d), d * width[front]
        corner = d * (lower - fronts.begin[front]) * line + column
        entry = (corner[:, None, None] + line[:, None, None] * inside[:, None] + inside).ravel()
        entry_begin = d * d * np.searchsorted(front, np.arange(len(pivots) + 1))
        self.num_entries = len(entry)
        self.shape = Shape(
            d * fronts.begin,
            d * fronts.row_begin,
            _singly(fronts.row, d),
            _singly(fronts.within, d),
            child_begin,
            child,
            np.append(0, np.cumsum(room)),
            entry_begin,
            entry,
        )
        self.most_rows, self.most_unknowns = d * int(rows.max(initial=0)), d * int(width.max(initial=0))
        self.num_waiting = _waiting(self.shape)
        self._count(d * pivots, d * rows)

    def _count(self, pivots: np.ndarray, rows: np.ndarray) -> None:
        """Stretches, and the work that they are."""
        products = _products(pivots, rows)
        is_dense = products > _DENSE
        units = _seconds(pivots, rows) / _UNIT_S
        number = _stretch(units * _UNIT_S, is_dense, _REST_S)
        first = np.flatnonzero(np.diff(number, prepend=-1))
        each = np.add.reduceat(units, first)
        lasts = np.append(first[1:], len(pivots))
        self.stretches = [
            Stretch(*each)
            for each in zip(first.tolist(), lasts.tolist(), is_dense[first].tolist(), each.tolist(), strict=True)
        ]
        self.units = float(units.sum())

    def corners(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """``(n,)`` where the entries begin, row by row, that tie blocks of ranks ``first`` ≤ ``second`` ``(n,)``."""
        return np.asarray(self.size**2 * np.searchsorted(self._ties, first * self.num_blocks + second))

    def places(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """``(n, d, d)`` all of them."""
        inside = np.arange(self.size**2).reshape(self.size, self.size)
        return np.asarray(self.corners(first, second)[:, None, None] + inside)

    @property
    def num_factor_entries(self) -> int:
        """Of the factor."""
        return int(self.shape.store[-1])


class _Fronts(NamedTuple):
    """In blocks, in the order of elimination.

    Attributes:
        place: ``(B,)`` where each block of the order before stands in this one.
        begin: ``(F + 1,)`` first pivot of each front.
        above: ``(F,)`` the front that each leaves its rows to, -1: none.
        row_begin, row, within: as :class:`Shape` has them.
    """

    place: np.ndarray
    begin: np.ndarray
    above: np.ndarray
    row_begin: np.ndarray
    row: np.ndarray
    within: np.ndarray


def _upper(first: np.ndarray, second: np.ndarray, num_blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """The upper triangle's columns, where each begins and its rows."""
    lower, upper = np.minimum(first, second), np.maximum(first, second)
    ties = np.unique(upper[lower != upper] * num_blocks + lower[lower != upper])
    begin = np.searchsorted(ties, num_blocks * np.arange(num_blocks + 1))
    return begin, (ties % num_blocks).astype(np.int32)


def _singly(blocks: np.ndarray, size: int) -> np.ndarray:
    """``(n d,)`` unknowns of blocks ``(n,)``."""
    return np.asarray((blocks[:, None] * size + np.arange(size)).ravel())


@compiled
def _products(pivots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Numbers that are multiplied to eliminate so many pivots beside so many rows."""
    products: np.ndarray = pivots * pivots * pivots / 6 + pivots * pivots * rows / 2 + pivots * rows * rows / 2
    return products


@compiled
def _seconds(pivots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """What fronts of so many pivots and rows take."""
    products = _products(pivots, rows)
    rate = np.where(products > _DENSE, _DENSE_PER_S, _PRODUCTS_PER_S)
    seconds: np.ndarray = _FRONT_S + products / rate + (rows * rows + pivots * (pivots + rows)) / _MOVES_PER_S
    return seconds


@compiled
def _merged(
    above: np.ndarray, counts: np.ndarray, factor_begin: np.ndarray, factor_row: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fronts of L's pattern in blocks: see :class:`_Fronts`.

    Columns that are tied to the same later ones are one front (fundamental supernodes, Liu, Ng and Peyton 1993), and a
    front takes in those below it that cost more by themselves.
    """
    num_blocks = len(above)
    num_below = np.zeros(num_blocks, np.int64)
    for j in range(num_blocks):
        if above[j] >= 0:
            num_below[above[j]] += 1
    of_column, first = np.empty(num_blocks, np.int64), np.empty(num_blocks, np.int64)
    count = 0
    for j in range(num_blocks):
        goes_on = j > 0 and above[j - 1] == j and counts[j] == counts[j - 1] - 1 and num_below[j] == 1
        if not goes_on:
            first[count] = j
            count += 1
        of_column[j] = count - 1
    last = np.empty(count, np.int64)
    for s in range(count):
        last[s] = (first[s + 1] if s + 1 < count else num_blocks) - 1
    pivots, rows, cost = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count)
    for s in range(count):
        pivots[s], rows[s] = last[s] - first[s] + 1, counts[last[s]]
    # Linked lists: those below each, and those that are one with it, in the order of elimination.
    below, beside = np.full(count, _NOWHERE), np.full(count, _NOWHERE)
    head, follows = np.arange(count), np.full(count, _NOWHERE)
    one, other = np.empty(1, np.int64), np.empty(1, np.int64)
    for s in range(count):
        one[0], other[0] = size * pivots[s], size * rows[s]
        cost[s] = _seconds(one, other)[0]
        many = 0
        child = below[s]
        while child >= 0:
            many += 1
            child = beside[child]
        children, by_rows = np.empty(many, np.int64), np.empty(many, np.int64)
        child, many = below[s], 0
        while child >= 0:
            children[many], by_rows[many] = child, -rows[child]
            many += 1
            child = beside[child]
        below[s] = _NOWHERE
        for at in np.argsort(by_rows, kind="mergesort"):
            child = children[at]
            one[0], other[0] = size * (pivots[s] + pivots[child]), size * rows[s]
            together = _seconds(one, other)[0]
            if together < cost[s] + cost[child]:
                pivots[s] += pivots[child]
                cost[s] = together
                follows[child] = head[s]
                head[s] = head[child]
                grandchild = below[child]
                while grandchild >= 0:
                    after = beside[grandchild]
                    beside[grandchild] = below[s]
                    below[s] = grandchild
                    grandchild = after
            else:
                beside[child] = below[s]
                below[s] = child
        if rows[s] > 0:
            parent = of_column[factor_row[factor_begin[last[s]]]]
            beside[s] = below[parent]
            below[parent] = s
    # Every front right after all below it.
    order, waiting = np.empty(count, np.int64), np.empty(count, np.int64)
    num_fronts, end = 0, 0
    for s in range(count):
        if rows[s] == 0:
            waiting[end] = s
            end += 1
    while end > 0:
        end -= 1
        s = waiting[end]
        order[num_fronts] = s
        num_fronts += 1
        child = below[s]
        while child >= 0:
            waiting[end] = child
            end += 1
            child = beside[child]
    order = order[:num_fronts][::-1]
    number = np.full(count, _NOWHERE)
    begin, row_begin = np.zeros(num_fronts + 1, np.int64), np.zeros(num_fronts + 1, np.int64)
    place = np.empty(num_blocks, np.int64)
    at = 0
    for f in range(num_fronts):
        s = order[f]
        number[s] = f
        part = head[s]
        while True:
            for j in range(first[part], last[part] + 1):
                place[j] = at
                at += 1
            if part == s:
                break
            part = follows[part]
        begin[f + 1] = at
        row_begin[f + 1] = row_begin[f] + rows[s]
    over = np.full(num_fronts, _NOWHERE)
    for f in range(num_fronts):
        child = below[order[f]]
        while child >= 0:
            over[number[child]] = f
            child = beside[child]
    row, within = np.empty(row_begin[-1], np.int64), np.empty(row_begin[-1], np.int64)
    for f in range(num_fronts):
        column = last[order[f]]
        for i in range(rows[order[f]]):
            row[row_begin[f] + i] = place[factor_row[factor_begin[column] + i]]
        row[row_begin[f] : row_begin[f + 1]].sort()
    for f in range(num_fronts):
        g = over[f]
        if g == _NOWHERE:
            continue
        among = row_begin[g]
        for i in range(row_begin[f], row_begin[f + 1]):
            if row[i] < begin[g + 1]:
                within[i] = row[i] - begin[g]
            else:
                while row[among] != row[i]:
                    among += 1
                within[i] = begin[g + 1] - begin[g] + among - row_begin[g]
    return place, begin, over, row_begin, row, within


@compiled
def _waiting(shape: Shape) -> int:
    """Numbers that wait on the stack at most, from below to above and the other way."""
    child_begin, row_begin = shape.child_begin, shape.row_begin
    num_fronts = len(child_begin) - 1
    up, down, most = 0, 0, 0
    for f in range(num_fronts):
        for at in range(child_begin[f], child_begin[f + 1]):
            child = shape.child[at]
            up -= (row_begin[child + 1] - row_begin[child]) ** 2
        up += (row_begin[f + 1] - row_begin[f]) ** 2
        most = max(most, up)
    for f in range(num_fronts - 1, -1, -1):
        down -= (row_begin[f + 1] - row_begin[f]) ** 2
        for at in range(child_begin[f], child_begin[f + 1]):
            child = shape.child[at]
            down += (row_begin[child + 1] - row_begin[child]) ** 2
        most = max(most, down)
    return most


@compiled
def _stretch(seconds: np.ndarray, is_dense: np.ndarray, longest: float) -> np.ndarray:
    """``(F,)`` which stretch each front belongs to."""
    number = np.zeros(len(seconds), np.int64)
    so_far = 0.0
    for f in range(len(seconds)):
        is_new = f > 0 and (is_dense[f] or is_dense[f - 1] or so_far + seconds[f] > longest)
        number[f] = number[f - 1] + 1 if is_new else (number[f - 1] if f > 0 else 0)
        so_far = seconds[f] if is_new else so_far + seconds[f]
    return number
