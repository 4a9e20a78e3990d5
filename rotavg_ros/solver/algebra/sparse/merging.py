"""Which columns of a sparse Cholesky factor are eliminated as one dense front.

Columns tied to the same later ones form one front (fundamental supernodes, Liu, Ng and Peyton 1993). A front absorbs
its children where that costs less than eliminating them separately.
"""

from __future__ import annotations

from typing import NamedTuple, TypeVar

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# Seconds that a front takes besides its arithmetic; multiplications and moved numbers per second, on one core of 2020.
# They decide which fronts are merged and how much work is counted; no answer depends on them.
_FRONT_S, _PRODUCTS_PER_S, _MOVES_PER_S = 1.5e-6, 3e9, 5e8
# From this number of multiplications on, products of whole matrices take less time; their multiplications per second.
DENSE, _DENSE_PER_S = 4e5, 2.5e10
_NOWHERE = -1

Numbers = TypeVar("Numbers", float, np.ndarray)


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


def products(pivots: Numbers, rows: Numbers) -> Numbers:
    """Number of multiplications to eliminate ``pivots`` that are tied to ``rows``; of one front, or of many."""
    number: Numbers = pivots * pivots * pivots / 6 + pivots * pivots * rows / 2 + pivots * rows * rows / 2
    return number


def seconds(number: Numbers, pivots: Numbers, rows: Numbers) -> Numbers:
    """Seconds that this ``number`` of multiplications takes, with all else that a front needs; likewise."""
    rate = _PRODUCTS_PER_S + (number > DENSE) * (_DENSE_PER_S - _PRODUCTS_PER_S)
    taken: Numbers = _FRONT_S + number / rate + (rows * rows + pivots * (pivots + rows)) / _MOVES_PER_S
    return taken


_products, _seconds = compiled(products), compiled(seconds)


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


def merged(
    above: np.ndarray, counts: np.ndarray, factor_begin: np.ndarray, factor_row: np.ndarray, size: int
) -> Fronts:
    """Fronts of L's pattern in blocks of ``size`` unknowns."""
    num_blocks = len(above)
    of_column, first = _supernodes(above, counts)
    count, last = len(first), np.append(first[1:], num_blocks) - 1
    rows, nowhere = counts[last], np.full((3, len(first)), _NOWHERE)
    tree = _Tree(first, last, last - first + 1, rows, np.arange(count), *nowhere)
    parent = np.full(count, _NOWHERE)
    parent[rows > 0] = of_column[factor_row[factor_begin[last[rows > 0]]]]
    # Those of many rows are absorbed first.
    child = np.lexsort((-np.arange(count), -rows, parent))
    _merge(tree, np.searchsorted(parent[child], np.arange(count + 1)), child, size)
    order = _upwards(tree)
    place, begin, over = _laid_out(tree, order, num_blocks)
    front = np.repeat(np.arange(len(order)), rows[order])
    row_begin = np.append(0, np.cumsum(rows[order]))
    entry = factor_begin[last[order]][front] + np.arange(len(front)) - row_begin[front]
    row = np.sort(front * num_blocks + place[factor_row[entry]]) - front * num_blocks
    return Fronts(place, begin, over, row_begin, row, _within(begin, over, row_begin, row))


@compiled
def _supernodes(above: np.ndarray, counts: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Supernode of each column ``(B,)``; and first column of each supernode, whose columns have the same rows."""
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
    return of_column, first[:count]


@compiled
def _merge(tree: _Tree, child_begin: np.ndarray, child: np.ndarray, size: int) -> None:
    """Absorb children that would cost more by themselves, in this order; every front's children come before it."""
    cost = np.empty(len(tree.first))
    for s in range(len(tree.first)):
        cost[s] = _cost(tree.pivots[s], tree.rows[s], size)
        for at in range(child_begin[s], child_begin[s + 1]):
            each = child[at]
            together = _cost(tree.pivots[s] + tree.pivots[each], tree.rows[s], size)
            if together < cost[s] + cost[each]:
                cost[s] = together
                tree.pivots[s] += tree.pivots[each]
                tree.follows[each] = tree.head[s]
                tree.head[s] = tree.head[each]
                grandchild = tree.below[each]
                while grandchild >= 0:
                    following = tree.beside[grandchild]
                    tree.beside[grandchild] = tree.below[s]
                    tree.below[s] = grandchild
                    grandchild = following
            else:
                tree.beside[each] = tree.below[s]
                tree.below[s] = each


@compiled
def _cost(pivots: int, rows: int, size: int) -> float:
    """Seconds that a front takes, given blocks of ``size`` unknowns."""
    number = _products(size * pivots, size * rows)
    return _seconds(number, size * pivots, size * rows)


@compiled
def _upwards(tree: _Tree) -> np.ndarray:
    """``(F,)`` fronts in postorder."""
    count = len(tree.first)
    order, waiting = np.empty(count, np.int64), np.empty(count, np.int64)
    begin, end = count, 0
    for s in range(count):
        if tree.rows[s] == 0:
            waiting[end] = s
            end += 1
    while end > 0:
        end -= 1
        s = waiting[end]
        begin -= 1
        order[begin] = s
        child = tree.below[s]
        while child >= 0:
            waiting[end] = child
            end += 1
            child = tree.beside[child]
    return order[begin:]


@compiled
def _laid_out(tree: _Tree, order: np.ndarray, num_blocks: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Position of each block ``(B,)``, first pivot of each front ``(F + 1,)``, and parent of each front ``(F,)``."""
    place, begin = np.empty(num_blocks, np.int64), np.zeros(len(order) + 1, np.int64)
    over, number, at = np.empty(len(order), np.int64), np.empty(len(tree.first), np.int64), 0
    for f in range(len(order)):
        number[order[f]], over[f] = f, _NOWHERE
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
