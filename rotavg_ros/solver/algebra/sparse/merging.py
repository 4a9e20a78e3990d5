"""Which columns of a sparse Cholesky factor are eliminated as one dense front.

Columns tied to the same later ones form one front (fundamental supernodes, Liu, Ng and Peyton 1993). A front absorbs
its children where that costs less than eliminating them separately.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# Seconds that a front takes besides its arithmetic; multiplications and moved numbers per second, on one core of 2020.
# They decide which fronts are merged and how much work is counted; no answer depends on them.
_FRONT_S, _PRODUCTS_PER_S, _MOVES_PER_S = 1.5e-6, 3e9, 5e8
# From this number of multiplications on, products of whole matrices take less time; their multiplications per second.
DENSE, _DENSE_PER_S = 4e5, 2.5e10
_NOWHERE = -1


class Fronts(NamedTuple):
    """Fronts in blocks, in the order of elimination.

    Attributes:
        place: ``(B,)`` position in this order of each block of the order before.
        begin: ``(F + 1,)`` first pivot of each front.
        above: ``(F,)`` parent of each front, which takes what is left of its rows; -1: none.
        row_begin, row, within: as :class:`~rotavg_ros.solver.algebra.sparse.elimination.Shape` has them.
    """

    place: np.ndarray
    begin: np.ndarray
    above: np.ndarray
    row_begin: np.ndarray
    row: np.ndarray
    within: np.ndarray


@compiled
def products(pivots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Number of multiplications to eliminate ``pivots`` that are tied to ``rows``."""
    number: np.ndarray = pivots * pivots * pivots / 6 + pivots * pivots * rows / 2 + pivots * rows * rows / 2
    return number


@compiled
def seconds(pivots: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Seconds that fronts of ``pivots`` and ``rows`` take."""
    number = products(pivots, rows)
    rate = np.where(number > DENSE, _DENSE_PER_S, _PRODUCTS_PER_S)
    taken: np.ndarray = _FRONT_S + number / rate + (rows * rows + pivots * (pivots + rows)) / _MOVES_PER_S
    return taken


class _Tree(NamedTuple):
    """S supernodes of L, which are merged to fronts; linked lists end with :data:`_NOWHERE`.

    Attributes:
        first, last: ``(S,)`` first and last column of each supernode.
        pivots, rows: ``(S,)`` blocks of each, including all that it has absorbed.
        head, follows: ``(S,)`` first supernode of each front, and the next one of the same front, in their order.
        below, beside: ``(S,)`` first child of each front, and its next sibling.
    """

    first: np.ndarray
    last: np.ndarray
    pivots: np.ndarray
    rows: np.ndarray
    head: np.ndarray
    follows: np.ndarray
    below: np.ndarray
    beside: np.ndarray


@compiled
def merged(
    above: np.ndarray, counts: np.ndarray, factor_begin: np.ndarray, factor_row: np.ndarray, size: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Fronts of L's pattern in blocks: see :class:`Fronts`."""
    of_column, tree = _supernodes(above, counts)
    num_nodes = len(tree.first)
    cost = np.empty(num_nodes)
    for s in range(num_nodes):
        cost[s] = _cost(tree.pivots[s], tree.rows[s], size)
        _take_in(tree, s, cost, size)
        if tree.rows[s] > 0:
            parent = of_column[factor_row[factor_begin[tree.last[s]]]]
            tree.beside[s] = tree.below[parent]
            tree.below[parent] = s
    order = _upwards(tree)
    place, begin, over = _laid_out(tree, order, len(above))
    row_begin = np.zeros(len(order) + 1, np.int64)
    for f in range(len(order)):
        row_begin[f + 1] = row_begin[f] + tree.rows[order[f]]
    row = np.empty(row_begin[-1], np.int64)
    for f in range(len(order)):
        column = tree.last[order[f]]
        for i in range(tree.rows[order[f]]):
            row[row_begin[f] + i] = place[factor_row[factor_begin[column] + i]]
        row[row_begin[f] : row_begin[f + 1]].sort()
    return place, begin, over, row_begin, row, _within(begin, over, row_begin, row)


@compiled
def _supernodes(above: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, _Tree]:
    """Supernode of each column ``(B,)``, and the supernodes: columns tied to the same later ones."""
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
    last, pivots, rows = np.empty(count, np.int64), np.empty(count, np.int64), np.empty(count, np.int64)
    for s in range(count):
        last[s] = (first[s + 1] if s + 1 < count else num_blocks) - 1
        pivots[s], rows[s] = last[s] - first[s] + 1, counts[last[s]]
    nowhere = np.full((3, count), _NOWHERE)
    lists = np.arange(count), nowhere[0], nowhere[1], nowhere[2]
    return of_column, _Tree(first[:count], last, pivots, rows, *lists)


@compiled
def _cost(pivots: int, rows: int, size: int) -> float:
    """Seconds that a front takes, given blocks of ``size`` unknowns."""
    taken: float = seconds(np.array([size * pivots]), np.array([size * rows]))[0]
    return taken


@compiled
def _take_in(tree: _Tree, s: int, cost: np.ndarray, size: int) -> None:
    """Absorb children that would cost more by themselves, those of many rows first."""
    below = _listed(tree, tree.below[s])
    tree.below[s] = _NOWHERE
    for at in np.argsort(-tree.rows[below], kind="mergesort"):
        child = below[at]
        together = _cost(tree.pivots[s] + tree.pivots[child], tree.rows[s], size)
        if together < cost[s] + cost[child]:
            cost[s] = together
            tree.pivots[s] += tree.pivots[child]
            tree.follows[child] = tree.head[s]
            tree.head[s] = tree.head[child]
            for grandchild in _listed(tree, tree.below[child]):
                tree.beside[grandchild] = tree.below[s]
                tree.below[s] = grandchild
        else:
            tree.beside[child] = tree.below[s]
            tree.below[s] = child


@compiled
def _listed(tree: _Tree, first: int) -> np.ndarray:
    """``(n,)`` a front and its later siblings."""
    many, each = 0, first
    while each >= 0:
        many += 1
        each = tree.beside[each]
    listed, each = np.empty(many, np.int64), first
    for at in range(many):
        listed[at] = each
        each = tree.beside[each]
    return listed


@compiled
def _upwards(tree: _Tree) -> np.ndarray:
    """``(F,)`` fronts in postorder."""
    count = len(tree.first)
    order, waiting = np.empty(count, np.int64), np.empty(count, np.int64)
    num_fronts, end = 0, 0
    for s in range(count):
        if tree.rows[s] == 0:
            waiting[end] = s
            end += 1
    while end > 0:
        end -= 1
        s = waiting[end]
        order[num_fronts] = s
        num_fronts += 1
        child = tree.below[s]
        while child >= 0:
            waiting[end] = child
            end += 1
            child = tree.beside[child]
    return order[:num_fronts][::-1]


@compiled
def _laid_out(tree: _Tree, order: np.ndarray, num_blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position of each block ``(B,)``, first pivot of each front ``(F + 1,)``, and parent of each front ``(F,)``."""
    place, begin, over = (
        np.empty(num_blocks, np.int64),
        np.zeros(len(order) + 1, np.int64),
        np.full(len(order), _NOWHERE),
    )
    number, at = np.full(len(tree.first), _NOWHERE), 0
    for f in range(len(order)):
        number[order[f]] = f
        part = tree.head[order[f]]
        while True:
            for j in range(tree.first[part], tree.last[part] + 1):
                place[j] = at
                at += 1
            if part == order[f]:
                break
            part = tree.follows[part]
        begin[f + 1] = at
        child = tree.below[order[f]]
        while child >= 0:  # children come before
            over[number[child]] = f
            child = tree.beside[child]
    return place, begin, over


@compiled
def _within(begin: np.ndarray, over: np.ndarray, row_begin: np.ndarray, row: np.ndarray) -> np.ndarray:
    """Position of each of a front's rows in the parent front, whose pivots come before its rows."""
    within = np.empty(len(row), np.int64)
    for f in range(len(over)):
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
    return within
