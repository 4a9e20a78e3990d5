"""The sparse system of poses: as :mod:`rotavg_ros.solver.slam.posterior.system`, with a block of unknowns a node.

A node's block is its turn (k components) and its shift (m), a run's block what its closures err in common. The three
blocks of a row are those of its target, its source and its run. H = Jᵀ W J is factorised once for each choice of J
and W; samples of N(0, H⁻¹) tell what everything else predicts of a row.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra.laplacian import solve_in_parts
from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.algebra.sparse_factor import SparseFactor
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import rest, spend, stop_if_abandoned

_NUM_PROBES, _SEED = 48, 0
# SuperLU merges no columns of unlike pattern: blocks are dense as they are, and merging fills in, on a sphere sixfold.
_RELAX, _PANEL = 1, 4
# Rows that tell each of their blocks less than this share of what all tell it are nothing; so many of them are worth a
# pattern without them.
_NEXT_TO_NOTHING, _WORTH_LEAVING_OUT = 1e-8, 200
# What a row decides itself is no more than all but this: nothing else may tell of it.
_LEAST = 1e-9
# What is left of a turn and of a shift has less in common than this share, squared.
_CORRELATED = 0.9
_TINY = np.finfo(np.float64).tiny


class BlockEquations:
    """The pattern of H for E rows between K nodes and R runs, d unknowns each.

    Args:
        size: (k, m) with d = k + m, components of a turn and of a shift.
        num_nodes: K.
        ends: ``(E, 2)`` sources and targets.
        run: ``(E,)`` in 0 … R − 1, or -1.
        roots: nodes that stay where they are.
        loose: nodes of which something is known beforehand: first ones of chains that odometry does not tie to a root.
    """

    def __init__(
        self,
        size: tuple[int, int],
        num_nodes: int,
        ends: np.ndarray,
        run: np.ndarray,
        roots: np.ndarray,
        loose: np.ndarray,
    ) -> None:
        num_runs = int(run.max(initial=-1)) + 1
        self.turns, self.size, self.num_edges = size[0], sum(size), len(ends)
        self.num_blocks, self.roots, self.loose = num_nodes + num_runs, roots, loose
        nowhere = self.num_blocks
        source, target = ends.T
        block = np.stack((target, source, np.where(run >= 0, num_nodes + run, nowhere)), axis=1)
        of_runs = np.stack((num_nodes + np.arange(num_runs), *[np.full(num_runs, nowhere)] * 2), axis=1)
        self.block = np.concatenate((block, of_runs))
        self.probes = np.random.default_rng(_SEED).standard_normal((len(self.block), self.size, _NUM_PROBES))
        self._pattern: _Pattern | None = None

    def factorise(
        self, jacobian: np.ndarray, root_weight: np.ndarray, loose_weight: np.ndarray | None = None
    ) -> BlockFactor:
        """Of whitened rows.

        Args:
            jacobian: ``(E + R, d, 3 d)`` W^½ J.
            root_weight: what ties roots down, ``(d,)``.
            loose_weight: how much is known beforehand of loose nodes, ``(d,)``; None: nothing.
        """
        stop_if_abandoned()
        pattern = self._pattern_of(jacobian)
        spend(pattern.matrix.nnz)
        matrix = pattern.matrix
        rows = jacobian if pattern.is_whole else jacobian[pattern.kept]
        blocks = np.matmul(rows.transpose(0, 2, 1), rows).ravel().take(pattern.used)
        values = np.bincount(pattern.slot, blocks, matrix.nnz)
        values[pattern.diagonal] += np.finfo(np.float64).tiny
        values[pattern.diagonal[pattern.rank[self.roots]]] += root_weight
        grounding = len(self.roots) * np.log(root_weight).sum()
        if loose_weight is not None:
            values[pattern.diagonal[pattern.rank[self.loose]]] += loose_weight
            grounding += len(self.loose) * np.log(loose_weight).sum()
        matrix.data = values
        factor = SparseFactor(matrix, is_ordered=True, relax=_RELAX, panel=_PANEL)
        return BlockFactor(self, pattern, pattern.rows(jacobian), factor, float(grounding))

    def _pattern_of(self, jacobian: np.ndarray) -> _Pattern:
        """Of the rows that tell anything: others fill the factor of a graph with many false closures for nothing."""
        counts = self._count(jacobian)
        pattern = self._pattern
        if pattern is None or not pattern.covers(counts):
            pattern = self._pattern = _Pattern(self, counts)
        return pattern

    def _count(self, jacobian: np.ndarray) -> np.ndarray:
        """``(E + R,)`` bool, rows that tell one of their blocks more than next to nothing beside the others.

        All of them, unless many do not and the rest ties every block to what these do.
        """
        d, num_blocks = self.size, self.num_blocks
        told = (jacobian**2).sum(axis=1).reshape(-1, 3, d).max(axis=2)
        of_block = np.bincount(self.block.ravel(), told.ravel(), num_blocks + 1)
        of_block[num_blocks] = np.inf
        counts: np.ndarray = (told > _NEXT_TO_NOTHING * of_block[self.block]).any(axis=1)
        is_worth = len(counts) - counts.sum() >= _WORTH_LEAVING_OUT
        everything = np.ones_like(counts)
        return counts if is_worth and self._num_parts(counts) == self._num_parts(everything) else everything

    def _num_parts(self, counts: np.ndarray) -> int:
        """How many parts some of the rows tie nodes together to; a run is held by what is known of it beforehand."""
        target, source = self.block[: self.num_edges][counts[: self.num_edges], :2].T
        links = coo_array((np.ones(len(target)), (target, source)), shape=(self.num_blocks,) * 2)
        return int(connected_components(links, directed=False)[0])


class _Pattern:
    """Where in compressed rows J's numbers stand and in compressed columns H's, blocks in the order of elimination.

    What a row has of no block stands beyond all columns of J.

    Args:
        equations: of B blocks and rows with blocks ``(E + R, 3)``.
        counts: ``(E + R,)`` bool, rows that H is made of.

    Attributes:
        kept: those rows.
        is_whole: whether they are all.
        rank: ``(B,)`` where each block stands in the order of elimination.
        matrix: H, of which ``data`` is to be set.
        used, slot: which entries of the products of rows make H, and where in its ``data`` they belong.
        diagonal: ``(B, d)`` likewise, of the block at each rank.
    """

    def __init__(self, equations: BlockEquations, counts: np.ndarray) -> None:
        self.kept, self.is_whole, self._counts = np.flatnonzero(counts), bool(counts.all()), counts
        d, num_blocks, nowhere = equations.size, equations.num_blocks, equations.num_blocks
        self.rank = _elimination_order(equations.block[self.kept], num_blocks)
        block = np.append(self.rank, nowhere)[equations.block]
        columns = (block[:, :, None] * d + np.arange(d)).reshape(len(block), 1, 3 * d)
        entries = np.broadcast_to(columns, (len(block), d, 3 * d)).ravel().astype(np.int32)
        begins = np.arange(0, len(entries) + 1, 3 * d, dtype=np.int32)
        shape = len(block) * d, (num_blocks + 1) * d
        self._rows: csr_array = csr_array((np.ones(len(entries)), entries, begins), shape=shape)
        block = block[self.kept]
        row, column = np.broadcast_arrays(block[:, :, None], block[:, None, :])
        is_used = ((row < num_blocks) & (column < num_blocks)).ravel()
        key = (column * num_blocks + row).ravel()[is_used]
        occupied, slot = np.unique(np.concatenate((key, np.arange(num_blocks) * (num_blocks + 1))), return_inverse=True)
        count = np.bincount(occupied // num_blocks, minlength=num_blocks)
        before = np.append(0, np.cumsum(count))
        within = np.arange(len(occupied)) - before[occupied // num_blocks]
        # Of a block the first number, and from one of its columns to the next as many as the blocks there have.
        start, stride = d * (d * before[occupied // num_blocks] + within), d * count[occupied // num_blocks]
        inside = np.arange(d)
        place = start[:, None, None] + stride[:, None, None] * inside + inside[:, None]
        self.used = np.flatnonzero(
            np.broadcast_to(is_used.reshape(-1, 3, 1, 3, 1), (len(block), 3, d, 3, d)).reshape(-1)
        )
        slots = np.zeros((len(is_used), d, d), dtype=np.int64)
        slots[is_used] = place[slot[: len(key)]]
        self.slot = slots.reshape(-1, 3, 3, d, d).transpose(0, 1, 3, 2, 4).ravel()[self.used]
        self.diagonal = place[slot[len(key) :]][:, inside, inside]
        rows = np.empty(d * d * len(occupied), dtype=np.int32)
        rows[place] = ((occupied % num_blocks) * d)[:, None, None] + inside[:, None]
        first = np.append(0, np.cumsum(np.repeat(d * count, d))).astype(np.int32)
        self.matrix: csc_array = csc_array((np.ones(len(rows)), rows, first), shape=(num_blocks * d, num_blocks * d))

    def covers(self, counts: np.ndarray) -> bool:
        """Whether it has all of these rows and few others."""
        missing, needless = counts & ~self._counts, self._counts & ~counts
        return not missing.any() and int(needless.sum()) < _WORTH_LEAVING_OUT

    def rows(self, jacobian: np.ndarray) -> csr_array:
        """W^½ J, ``((E + R) d, (B + 1) d)``, columns in the order of elimination and those of no block."""
        # SciPy's constructors check each time what stays as it is.
        rows = copy(self._rows)
        rows.data = jacobian.ravel()
        return rows


def _elimination_order(block: np.ndarray, num_blocks: int) -> np.ndarray:
    """``(blocks,)`` where each stands in the order of minimum degree of the blocks' graph."""
    row, column = (ends.ravel() for ends in np.broadcast_arrays(block[:, :, None], block[:, None, :]))
    is_used = (row < num_blocks) & (column < num_blocks) & (row != column)
    row, column = row[is_used], column[is_used]
    # Any positive definite matrix of the pattern will do.
    degree = np.bincount(row, minlength=num_blocks)
    diagonal = np.arange(num_blocks)
    values = np.concatenate((np.full(len(row), -1.0), degree + 1.0))
    shape = num_blocks, num_blocks
    graph: csc_array = csc_array(
        (values, (np.concatenate((row, diagonal)), np.concatenate((column, diagonal)))), shape=shape
    )
    return SparseFactor(graph, is_ordered=False, relax=_RELAX, panel=_PANEL).rank


class BlockFactor:
    """H for one choice of J and W, here in the order of elimination."""

    def __init__(
        self, system: BlockEquations, pattern: _Pattern, rows: csr_array, factor: SparseFactor, grounding: float
    ) -> None:
        self._system, self._rank, self._rows = system, pattern.rank, rows
        self._factor, self._grounding = factor, grounding

    @property
    def log_det(self) -> float:
        """Log det H, without what ties the roots down and what is known of loose nodes beforehand."""
        return self._factor.log_det - self._grounding

    @property
    def num_entries(self) -> int:
        """Of the factor."""
        return self._factor.num_entries

    def fit(self, whitened: np.ndarray) -> np.ndarray:
        """Unknowns ``(blocks, d, n)`` that explain whitened rows ``(E + R, d, n)`` best."""
        return self._by_block(self._fit(whitened))

    def _fit(self, whitened: np.ndarray) -> np.ndarray:
        """The same in the order of elimination, ``(blocks d, n)``."""
        stop_if_abandoned()
        rest()
        right = self._rows.T @ whitened.reshape(-1, whitened.shape[2])
        return solve_in_parts(self._factor, right[: -self._system.size])

    def _by_block(self, ordered: np.ndarray) -> np.ndarray:
        """``(blocks, d, n)``, in which block v stood at its rank."""
        system = self._system
        return ordered.reshape(system.num_blocks, system.size, -1).take(self._rank, axis=0)

    def solve(self, columns: np.ndarray) -> np.ndarray:
        """H⁻¹ of columns ``(blocks, d, n)``."""
        ordered = np.empty_like(columns)
        ordered[self._rank] = columns
        return self._by_block(solve_in_parts(self._factor, ordered.reshape(-1, columns.shape[2])))

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Whitened rows ``(E + R, d, n)`` of unknowns ``(blocks, d, n)``."""
        ordered = np.empty_like(unknowns)
        ordered[self._rank] = unknowns
        return self._predicted(ordered.reshape(-1, unknowns.shape[2]))

    def _predicted(self, ordered: np.ndarray) -> np.ndarray:
        d, count = self._system.size, ordered.shape[1]
        padded = np.concatenate((ordered, np.zeros((d, count))))
        return np.asarray((self._rows @ padded).reshape(-1, d, count))

    @cached_property
    def _samples(self) -> np.ndarray:
        return self._fit(self._system.probes)

    @property
    def samples(self) -> np.ndarray:
        """Unknowns ``(blocks, d, 48)`` drawn from N(0, H⁻¹)."""
        return self._by_block(self._samples)

    @cached_property
    def leverage(self) -> np.ndarray:
        """``(E + R, d, d)`` Λ, what of a whitened row its own measurement decides.

        Of a row's own probe z ~ N(0, I) the fit takes up y, and y ~ N(0, Λ), z − y ~ N(0, I − Λ) are independent. Of
        turns and of shifts by themselves their moments A and B make L⁻¹ A L⁻ᵀ with L Lᵀ = A + B (a matrix-variate
        beta), near which Λ is, at both ends.
        """
        return self._shares[0]

    @cached_property
    def redundancy(self) -> np.ndarray:
        """``(E + R, d, d)`` I − Λ, positive definite."""
        return self._shares[1]

    @cached_property
    def _shares(self) -> tuple[np.ndarray, np.ndarray]:
        k, d = self._system.turns, self._system.size
        taken = self._predicted(self._samples)
        left = self._system.probes - taken
        moments = [np.matmul(part, part.transpose(0, 2, 1)) / _NUM_PROBES for part in (taken, left)]
        both = moments[0] + moments[1]
        # A turn's moments with a shift's are noise where one of the two hardly counts, and it is as slight as that in y
        # or in z − y by itself, but not in their sum: nothing of the one's leverage may get into the other's.
        root = np.zeros_like(both)
        root[:, :k, :k], root[:, k:, k:] = inverse_root(both[:, :k, :k]), inverse_root(both[:, k:, k:])
        of_taken, of_left = (np.matmul(root, np.matmul(part, root.transpose(0, 2, 1))) for part in moments)
        of_left += _LEAST * np.eye(d)
        across = _slighter(of_taken[:, :k, k:], -of_left[:, :k, k:])
        room = _least_value(of_left[:, :k, :k]) * _least_value(of_left[:, k:, k:])
        square = (across**2).sum(axis=(1, 2))
        across *= np.sqrt(np.minimum(_CORRELATED * room / np.maximum(square, _TINY), 1.0))[:, None, None]
        for share, sign in ((of_taken, 1), (of_left, -1)):
            share[:, :k, k:] = sign * across
            share[:, k:, :k] = share[:, :k, k:].transpose(0, 2, 1)
        return of_taken, of_left


def _slighter(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Of two matrices ``(n, k, m)`` each, that of fewer squares."""
    is_first = (a**2).sum(axis=(1, 2)) <= (b**2).sum(axis=(1, 2))
    return np.where(is_first[:, None, None], a, b)


def _least_value(matrix: np.ndarray) -> np.ndarray:
    """``(n,)`` no more than the least eigenvalues of ``(n, k, k)``."""
    return np.asarray(1 / (inverse_root(matrix) ** 2).sum(axis=(1, 2)))
