"""Cholesky's factor of a sparse symmetric matrix of blocks, by dense fronts (Duff and Reid 1983; Liu 1992).

Blocks are eliminated in an order of little fill. A front is a run of them, its pivots, and the later blocks that these
are tied to, its rows. It is a dense matrix: its own part of the matrix and what the fronts below leave. Pivots are
eliminated, and what is left of the rows goes to the front above. All arithmetic is products of dense matrices, which
take a tenth of the time that entry by entry would; the rest is what a front costs besides, so small ones are merged.

Between fronts a solve may rest, and other threads run within them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor, tied_matrix
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import rest, spend, stop_if_abandoned

# What a front takes besides its arithmetic, seconds; numbers multiplied and moved a second, on one core of 2020. They
# decide on merging and are what work is counted in; no answer depends on them.
_FRONT_S, _PRODUCTS_PER_S, _MOVES_PER_S = 3.6e-5, 2.5e10, 6.7e8
# Seconds to a unit: as long as one takes of a solve by rotations alone, with all that is done around it.
_UNIT_S = 5e-4
# Where rounding leaves a front without a pivot, so much of its largest diagonal is added, and ever more, up to that.
_LIFT, _MORE, _NO_ROUNDING = 1e-15, 16.0, 1.0


@dataclass(frozen=True)
class _Front:
    """Places in a matrix whose blocks are in the order of elimination, in single rows.

    Attributes:
        begin, end: its pivots are these.
        rows: ``(r,)`` later ones that they are tied to, ascending.
        above: the front that is left its rows; -1: none.
        split: so many of its rows are pivots there.
        within: ``(r,)`` where each stands there, among pivots or among rows.
    """

    begin: int
    end: int
    rows: np.ndarray
    above: int
    split: int
    within: np.ndarray

    @cached_property
    def later(self) -> torch.Tensor:
        """Its rows."""
        return torch.from_numpy(self.rows)

    @property
    def shape(self) -> tuple[int, int]:
        """Pivots, and these with its rows."""
        return self.end - self.begin, self.end - self.begin + len(self.rows)

    @property
    def seconds(self) -> float:
        """To eliminate it, about."""
        return _seconds(self.end - self.begin, len(self.rows))


class Elimination:
    """In which order, and in which fronts, a pattern of blocks is eliminated.

    Args:
        first, second: ``(E,)`` each, blocks that are tied, in any order and as often as it comes.
        num_blocks: B.
        size: d, unknowns of a block.

    Attributes:
        rank: ``(B,)`` where each block stands in the order.
        num_entries: numbers that :class:`Cholesky` is given.
        units: of work that it takes.
    """

    def __init__(self, first: np.ndarray, second: np.ndarray, num_blocks: int, size: int) -> None:
        self.num_blocks, self.size = num_blocks, size
        factor = SparseFactor(tied_matrix(first, second, num_blocks), is_ordered=False)
        begin, row = factor.lower_pattern
        rest()
        supernodes = _Supernodes.of(begin, row, size)
        order = supernodes.merged()
        # What is merged stands together, so blocks stand in an order of their own.
        blocks = np.concatenate([np.arange(supernodes.first[s], supernodes.last[s] + 1) for s in order.members])
        place = np.empty(num_blocks, dtype=np.int64)
        place[blocks] = np.arange(num_blocks)
        self.rank = place[factor.rank]
        self._ends = np.cumsum(order.num_pivots)
        self._starts = self._ends - order.num_pivots
        tied = [np.sort(place[row[begin[last] + 1 : begin[last + 1]]]) for last in supernodes.last[order.top]]
        self._first_row = np.append(0, np.cumsum([len(blocks) for blocks in tied]))
        # Ascending, so that where a block stands among a front's rows can be looked up.
        self._key = np.repeat(np.arange(len(tied)), np.diff(self._first_row)) * num_blocks + np.concatenate(tied)
        self.fronts = [self._front(number, tied, int(above)) for number, above in enumerate(order.above)]
        self.units = sum(front.seconds for front in self.fronts) / _UNIT_S
        rest()
        self._lay_out(self.rank[first], self.rank[second])

    def _front(self, number: int, tied: list[np.ndarray], above: int) -> _Front:
        """One of them.

        Args:
            number: its place in the order.
            tied: of each front the blocks that are its rows.
            above: the front that it leaves these to, -1: none.
        """
        blocks, split, within = tied[number], 0, tied[number]
        if above >= 0:
            split = int(np.searchsorted(blocks, self._ends[above]))
            among_rows = np.searchsorted(tied[above], blocks[split:])
            within = np.concatenate((blocks[:split] - self._starts[above], among_rows))
        d = self.size
        rows, within = (_singly(each, d) for each in (blocks, within))
        return _Front(int(self._starts[number]) * d, int(self._ends[number]) * d, rows, above, split * d, within)

    def _lay_out(self, first: np.ndarray, second: np.ndarray) -> None:
        """Where numbers stand that tie blocks of ranks ``(E,)`` to each other, and blocks to themselves."""
        d, diagonal = self.size, np.arange(self.num_blocks)
        lower, upper = np.minimum(first, second), np.maximum(first, second)
        ties = np.concatenate((lower * self.num_blocks + upper, diagonal * self.num_blocks + diagonal))
        self._ties = np.unique(ties)
        lower, upper = self._ties // self.num_blocks, self._ties % self.num_blocks
        front = np.searchsorted(self._ends, lower, side="right")
        pivots, width = (np.array(sizes)[front] for sizes in zip(*(each.shape for each in self.fronts), strict=True))
        row = np.searchsorted(self._key, front * self.num_blocks + upper) - self._first_row[front]
        column = np.where(upper < self._ends[front], d * (upper - self._starts[front]), pivots + d * row)
        inside = np.arange(d)
        corner = d * (lower - self._starts[front]) * width + column
        self._place = (corner[:, None, None] + width[:, None, None] * inside[:, None] + inside).ravel()
        self._of_front = d * d * np.searchsorted(front, np.arange(len(self.fronts) + 1))
        self.num_entries = len(self._place)

    def places(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """``(n, d, d)`` which entries tie blocks of ranks ``first`` ≤ ``second`` ``(n,)``."""
        tie = np.searchsorted(self._ties, first * self.num_blocks + second)
        return np.asarray(tie[:, None, None] * self.size**2 + np.arange(self.size**2).reshape(self.size, self.size))

    def own_part(self, number: int, entries: np.ndarray) -> torch.Tensor:
        """``(p, p + r)`` of all entries those of a front's p pivots, against these and its rows."""
        of_front = slice(self._of_front[number], self._of_front[number + 1])
        part = _zeros(*self.fronts[number].shape)
        part.numpy().reshape(-1)[self._place[of_front]] = entries[of_front]
        return part

    def asked(self, columns: np.ndarray) -> list[int]:
        """Fronts, from below, in which columns ``(B d, k)`` have numbers, and all above these."""
        block = np.flatnonzero(columns.any(axis=1)) // self.size
        asked = set(np.unique(np.searchsorted(self._ends, block, side="right")).tolist())
        for number in sorted(asked):
            while (number := self.fronts[number].above) >= 0 and number not in asked:
                asked.add(number)
        return sorted(asked)


class Cholesky:
    """L Lᵀ of a matrix, one pair of dense matrices a front.

    Args:
        elimination: of its pattern.
        entries: ``(num_entries,)`` the matrix at :meth:`Elimination.places`, those of a diagonal block whole or its
            upper triangle.

    Raises:
        RuntimeError: the matrix is far from positive definite.
    """

    def __init__(self, elimination: Elimination, entries: np.ndarray) -> None:
        self.elimination = elimination
        self._upper: list[torch.Tensor] = []
        self._beside: list[torch.Tensor] = []
        given: list[list[tuple[_Front, torch.Tensor]]] = [[] for _ in elimination.fronts]
        for number, front in enumerate(elimination.fronts):
            stop_if_abandoned()
            spend(front.seconds / _UNIT_S)
            own = elimination.own_part(number, entries)
            num_pivots, num_rows = len(own), len(front.rows)
            left = _zeros(num_rows, num_rows)
            for below, rest_of_it in given[number]:
                _add(rest_of_it.numpy(), below, own.numpy(), left.numpy())
            given[number] = []
            lower = _lower_root(own[:, :num_pivots].T)
            beside = torch.linalg.solve_triangular(lower, own[:, num_pivots:], upper=False)
            if num_rows:
                left.addmm_(beside.T, beside, alpha=-1.0)
                given[front.above].append((front, left))
            self._upper.append(lower.T)
            self._beside.append(beside)

    @property
    def num_entries(self) -> int:
        """Of the factor."""
        return sum(pivots * width for pivots, width in (front.shape for front in self.elimination.fronts))

    @property
    def log_det(self) -> float:
        """Of the matrix."""
        return 2 * float(torch.cat([upper.diagonal() for upper in self._upper]).log().sum())

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """The solution of ``(B d, k)`` columns, blocks in the order of elimination."""
        return self.ended(self.begun(right_hand_side))

    def begun(self, right_hand_side: np.ndarray) -> np.ndarray:
        """L⁻¹ of columns ``(B d, k)``, the matrix being L Lᵀ; where they have numbers and in fronts above those."""
        solution = torch.tensor(right_hand_side)
        for number in self.elimination.asked(right_hand_side):
            rest()
            front, beside = self.elimination.fronts[number], self._beside[number]
            own = solution[front.begin : front.end]
            own.copy_(torch.linalg.solve_triangular(self._upper[number].T, own, upper=False))
            solution.index_add_(0, front.later, beside.T @ own, alpha=-1.0)
        return np.asarray(solution.numpy())

    def ended(self, half: np.ndarray) -> np.ndarray:
        """L⁻ᵀ of columns ``(B d, k)``."""
        solution = torch.tensor(half)
        fronts = self.elimination.fronts
        owns = torch.split(solution, [front.end - front.begin for front in fronts])
        for front, own, upper, beside in reversed(list(zip(fronts, owns, self._upper, self._beside, strict=True))):
            rest()
            told = torch.addmm(own, beside, solution.index_select(0, front.later), alpha=-1.0)
            own.copy_(torch.linalg.solve_triangular(upper, told, upper=True))
        return np.asarray(solution.numpy())


def _zeros(rows: int, columns: int) -> torch.Tensor:
    """In memory of torch's own, whose products come out alike to the last bit wherever that lies."""
    return torch.zeros(rows, columns, dtype=torch.float64)


def _add(given: np.ndarray, below: _Front, part: np.ndarray, left: np.ndarray) -> None:
    """What a front below is left ``(r, r)``, to the own part ``(p, p + R)`` and what is to be left ``(R, R)``."""
    (num_pivots, width), split, within = part.shape, below.split, below.within
    # On one axis this takes a fifth of the time that it takes on two.
    if split:
        column = np.concatenate((within[:split], num_pivots + within[split:]))
        np.add.at(part.reshape(-1), (within[:split, None] * width + column).ravel(), given[:split].ravel())
    if split < len(within):
        column = within[split:]
        np.add.at(left.reshape(-1), (column[:, None] * len(left) + column).ravel(), given[split:, split:].ravel())


def _lower_root(matrix: torch.Tensor) -> torch.Tensor:
    """L of L Lᵀ, of a matrix of which the lower triangle is read; lifted where rounding has left it no root."""
    lower: torch.Tensor
    lower, info = torch.linalg.cholesky_ex(matrix)
    lift = _LIFT
    while int(info):
        if lift > _NO_ROUNDING:
            raise RuntimeError("a matrix that is to be factorised is not positive definite")
        diagonal = matrix.diagonal()
        diagonal += lift * float(diagonal.abs().max())
        lower, info = torch.linalg.cholesky_ex(matrix)
        lift *= _MORE
    return lower


def _singly(blocks: np.ndarray, size: int) -> np.ndarray:
    """``(n d,)`` rows of blocks ``(n,)``."""
    return np.asarray((blocks[:, None] * size + np.arange(size)).ravel())


def _seconds(pivots: float, rows: float) -> float:
    """What a front takes."""
    products = pivots**3 / 3 + pivots**2 * rows + 2 * pivots * rows**2
    return _FRONT_S + products / _PRODUCTS_PER_S + (rows**2 + pivots * (pivots + rows) / 4) / _MOVES_PER_S


@dataclass(frozen=True)
class _Order:
    """Fronts in the order of elimination.

    Attributes (F fronts of S supernodes):
        members: ``(S,)`` supernodes, those of a front together.
        num_pivots: ``(F,)`` blocks.
        top: ``(F,)`` the supernode that a front's rows are those of.
        above: ``(F,)`` the front that it leaves its rows to, -1: none.
    """

    members: list[int]
    num_pivots: np.ndarray
    top: np.ndarray
    above: np.ndarray


@dataclass(frozen=True)
class _Supernodes:
    """Runs of columns of L that are tied to the same others.

    Attributes (S of them):
        first, last: ``(S,)`` columns.
        above: S numbers, of the supernode that each one's rows begin in, -1: none.
        num_rows: S numbers of blocks.
        size: d.
    """

    first: np.ndarray
    last: np.ndarray
    above: list[int]
    num_rows: list[int]
    size: int

    @classmethod
    def of(cls, begin: np.ndarray, row: np.ndarray, size: int) -> _Supernodes:
        """Of L's pattern ``(B + 1,)``, ``(entries,)`` in compressed columns, rows ascending, the diagonal first."""
        count = np.diff(begin)
        num_blocks = len(count)
        above = np.full(num_blocks, -1)
        has_rows = count > 1
        above[has_rows] = row[begin[:-1][has_rows] + 1]
        below = np.bincount(above[above >= 0], minlength=num_blocks)
        goes_on = (above[:-1] == np.arange(1, num_blocks)) & (count[1:] == count[:-1] - 1) & (below[1:] == 1)
        first = np.flatnonzero(np.append(True, ~goes_on))
        last = np.append(first[1:], num_blocks) - 1
        of_column = np.repeat(np.arange(len(first)), last - first + 1)
        over = np.where(above[last] >= 0, of_column[above[last]], -1)
        return cls(first, last, over.tolist(), (count[last] - 1).tolist(), size)

    def merged(self) -> _Order:
        """Fronts: a supernode takes in those below it that cost more by themselves."""
        d, count = self.size, len(self.first)
        pivots = (self.last - self.first + 1).tolist()
        cost = [_seconds(d * p, d * r) for p, r in zip(pivots, self.num_rows, strict=True)]
        members: list[list[int]] = [[number] for number in range(count)]
        below: list[list[int]] = [[] for _ in range(count)]
        for number in range(count):
            stay: list[int] = []
            for other in sorted(below[number], key=lambda other: -self.num_rows[other]):
                together = _seconds(d * (pivots[number] + pivots[other]), d * self.num_rows[number])
                if together < cost[number] + cost[other]:
                    pivots[number] += pivots[other]
                    cost[number] = together
                    members[number] = members[other] + members[number]
                    stay += below[other]
                else:
                    stay.append(other)
            below[number] = stay
            if self.above[number] >= 0:
                below[self.above[number]].append(number)
        order = self._after_what_is_below(below)
        place = dict(zip(order, range(len(order)), strict=True))
        above = np.full(len(order), -1)
        for number in order:
            above[[place[other] for other in below[number]]] = place[number]
        in_order = [supernode for number in order for supernode in members[number]]
        return _Order(in_order, np.array([pivots[number] for number in order]), np.array(order), above)

    def _after_what_is_below(self, below: list[list[int]]) -> list[int]:
        """Those that are left, each after all below it."""
        order, waiting = [], [number for number, above in enumerate(self.above) if above < 0]
        while waiting:
            order.append(waiting.pop())
            waiting += below[order[-1]]
        return order[::-1]
