"""The order, and the dense fronts, in which a sparse symmetric matrix of blocks is eliminated.

Blocks are eliminated in an order of little fill. A front consists of a run of blocks, its pivots, and of the later
blocks that these are tied to, its rows (Duff and Reid 1983; Liu 1992). Elimination leaves a matrix between the rows,
which is added to the parent front. Fronts are in postorder, so these matrices wait on a stack.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.sparse import merging
from rotavg_ros.solver.algebra.sparse.elimination_tree import elimination_tree, factor_rows
from rotavg_ros.solver.algebra.sparse.merging import Fronts, merged
from rotavg_ros.solver.algebra.sparse.sparse_factor import order_of_little_fill
from rotavg_ros.solver.running.work import spend

# Seconds per unit of work: as long as a unit takes in a solve by rotations alone, with everything done around it.
_UNIT_S = 5e-4
# Seconds after which a solve may rest.
_REST_S = 1e-3
# Every front's matrix begins at a multiple of this many numbers, so that products are the same to the last bit.
_ALIGNED = 8
# Units of work per block, for each part of finding the pattern.
_BLOCK = 0.004


class Shape(NamedTuple):
    """The layout of F fronts, in single unknowns in the order of elimination.

    Attributes:
        begin: ``(F + 1,)`` first pivot of each front.
        row_begin, row: ``(F + 1,)`` where each front's rows begin; the later unknowns tied to its pivots, ascending.
        within: position of each of these rows in the parent front, whose pivots come before its rows.
        child_begin, child: ``(F + 1,)`` where each front's children begin; the children, ascending.
        store: ``(F + 1,)`` where each front's part of the factor begins: pivots against pivots and rows.
        entry_begin, entry: ``(F + 1,)`` where each front's entries of the matrix begin; their positions in that part.
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
        first, last: the fronts from ``first`` to ``last`` - 1.
        is_dense: whether it is one front, so large that products of whole matrices take less time.
        units: units of work that they take.
    """

    first: int
    last: int
    is_dense: bool
    units: float


class Elimination:
    """The order and the fronts of a pattern of blocks.

    Args:
        first, second: ``(E,)`` pairs of tied blocks, in any order, repeated or not.
        num_blocks: B.
        size: d, unknowns per block.

    Attributes:
        rank: ``(B,)`` position of each block in the order.
        shape: the layout of the fronts.
        stretches: of fronts, in order.
        num_entries: number of entries of the matrix, see :meth:`places`.
        num_waiting: largest size of the stack, in numbers, upwards or downwards.
        most_rows, most_unknowns: largest numbers of any front.
        units: units of work that the elimination takes.
    """

    def __init__(self, first: np.ndarray, second: np.ndarray, num_blocks: int, size: int) -> None:
        self.num_blocks, self.size = num_blocks, size
        spend(_BLOCK * num_blocks)
        order = order_of_little_fill(first, second, num_blocks)
        spend(_BLOCK * num_blocks)
        begin, row = _upper(order[first], order[second], num_blocks)
        above, counts = elimination_tree(begin, row)
        factor_begin = np.append(0, np.cumsum(counts))
        factor_row = factor_rows(begin, row, above, factor_begin)
        spend(_BLOCK * num_blocks)
        fronts = merged(above, counts, factor_begin, factor_row, size)
        self.rank = fronts.place[order]
        spend(_BLOCK * num_blocks)
        lower, upper = np.minimum(self.rank[first], self.rank[second]), np.maximum(self.rank[first], self.rank[second])
        self._lay_out(fronts, lower, upper)

    def _lay_out(self, fronts: Fronts, lower: np.ndarray, upper: np.ndarray) -> None:
        """Lay out the fronts in single unknowns, with entries for tied blocks ``lower`` ≤ ``upper`` ``(E,)``."""
        d, num_blocks, diagonal = self.size, self.num_blocks, np.arange(self.num_blocks)
        pivots, rows = np.diff(fronts.begin), np.diff(fronts.row_begin)
        width = pivots + rows
        room = -(-d * d * pivots * width // _ALIGNED) * _ALIGNED
        child_begin = np.append(0, np.cumsum(np.bincount(fronts.above + 1, minlength=len(pivots) + 1)[1:]))
        child = np.argsort(fronts.above, kind="stable")[np.count_nonzero(fronts.above < 0) :]
        self._ties = np.unique(np.concatenate((lower * num_blocks + upper, diagonal * num_blocks + diagonal)))
        lower, upper = self._ties // num_blocks, self._ties % num_blocks
        front = np.searchsorted(fronts.begin, lower, side="right") - 1
        # Ascending, so that a block's position among a front's rows can be looked up.
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
        """Find the stretches, and count their work."""
        products = merging.products(pivots, rows)
        is_dense = products > merging.DENSE
        units = merging.seconds(products, pivots, rows) / _UNIT_S
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
        """``(n,)`` where entries between blocks of ranks ``first`` ≤ ``second`` ``(n,)`` begin; they go row by row."""
        return np.asarray(self.size**2 * np.searchsorted(self._ties, first * self.num_blocks + second))

    def places(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """``(n, d, d)`` positions of all entries of these pairs of blocks."""
        inside = np.arange(self.size**2).reshape(self.size, self.size)
        return np.asarray(self.corners(first, second)[:, None, None] + inside)

    @property
    def num_factor_entries(self) -> int:
        """Number of entries of the factor."""
        return int(self.shape.store[-1])


def _upper(first: np.ndarray, second: np.ndarray, num_blocks: int) -> tuple[np.ndarray, np.ndarray]:
    """The upper triangle by columns: where each begins, and its rows."""
    lower, upper = np.minimum(first, second), np.maximum(first, second)
    ties = np.unique(upper[lower != upper] * num_blocks + lower[lower != upper])
    begin = np.searchsorted(ties, num_blocks * np.arange(num_blocks + 1))
    return begin, (ties % num_blocks).astype(np.int32)


def _singly(blocks: np.ndarray, size: int) -> np.ndarray:
    """``(n d,)`` unknowns of blocks ``(n,)``."""
    return np.asarray((blocks[:, None] * size + np.arange(size)).ravel())


@compiled
def _waiting(shape: Shape) -> int:
    """Largest size of the stack, in numbers, from children to parents or the other way."""
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
    """``(F,)`` stretch of each front."""
    number = np.zeros(len(seconds), np.int64)
    so_far = 0.0
    for f in range(len(seconds)):
        is_new = f > 0 and (is_dense[f] or is_dense[f - 1] or so_far + seconds[f] > longest)
        number[f] = number[f - 1] + 1 if is_new else (number[f - 1] if f > 0 else 0)
        so_far = seconds[f] if is_new else so_far + seconds[f]
    return number
