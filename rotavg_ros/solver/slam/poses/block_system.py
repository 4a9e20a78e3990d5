"""The sparse system of poses: as :mod:`rotavg_ros.solver.slam.posterior.system`, with a block of unknowns a node.

A node's block is its turn (k components) and its shift (m), a run's block what its closures err in common. The three
blocks of a row are those of its target, its source and its run. H = Jᵀ W J is factorised once for each choice of J
and W; samples of N(0, H⁻¹) tell what everything else predicts of a row.
"""

from __future__ import annotations

from copy import copy

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.algebra.sparse.multifrontal import Cholesky, Elimination
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import rest, spend, stop_if_abandoned

_NUM_PROBES, _SEED = 48, 0
# What a solve of the samples costs, in what the factor does.
_SOLVED = 0.5
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
        rest()
        rows = jacobian if pattern.is_whole else jacobian[pattern.kept]
        blocks = np.matmul(rows.transpose(0, 2, 1), rows).ravel().take(pattern.used)
        entries = np.bincount(pattern.slot, blocks, pattern.elimination.num_entries)
        entries[pattern.diagonal] += np.finfo(np.float64).tiny
        entries[pattern.diagonal[self.roots]] += root_weight
        grounding = len(self.roots) * np.log(root_weight).sum()
        if loose_weight is not None:
            entries[pattern.diagonal[self.loose]] += loose_weight
            grounding += len(self.loose) * np.log(loose_weight).sum()
        factor = Cholesky(pattern.elimination, entries)
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
    """Where in compressed rows J's numbers stand, and in the fronts of H's factor its own.

    What a row has of no block stands beyond all columns of J.

    Args:
        equations: of B blocks and rows with blocks ``(E + R, 3)``.
        counts: ``(E + R,)`` bool, rows that H is made of.

    Attributes:
        kept: those rows.
        is_whole: whether they are all.
        elimination: of H.
        rank: ``(B,)`` where each block stands in the order of elimination.
        used, slot: which entries of the products of rows make H, and where they belong.
        diagonal: ``(B, d)`` likewise, of each block.
    """

    def __init__(self, equations: BlockEquations, counts: np.ndarray) -> None:
        self.kept, self.is_whole, self._counts = np.flatnonzero(counts), bool(counts.all()), counts
        d, num_blocks, nowhere = equations.size, equations.num_blocks, equations.num_blocks
        blocks = equations.block[self.kept]
        first, second = (ends.ravel() for ends in np.broadcast_arrays(blocks[:, :, None], blocks[:, None, :]))
        pair = np.flatnonzero((first < nowhere) & (second < nowhere))
        self.elimination = Elimination(first[pair], second[pair], num_blocks, d)
        self.rank = self.elimination.rank
        rest()
        # Half of what is symmetric.
        pair = pair[self.rank[first[pair]] <= self.rank[second[pair]]]
        self.slot = self.elimination.places(self.rank[first[pair]], self.rank[second[pair]]).ravel()
        inside = np.arange(d)
        row, one, other = pair // 9, pair // 3 % 3, pair % 3
        product = ((row * 3 + one)[:, None] * d + inside) * 3 + other[:, None]
        self.used = (product[:, :, None] * d + inside).ravel()
        self.diagonal = self.elimination.places(self.rank, self.rank)[:, inside, inside]
        block = np.append(self.rank, nowhere)[equations.block]
        columns = (block[:, :, None] * d + inside).reshape(len(block), 1, 3 * d)
        entries = np.broadcast_to(columns, (len(block), d, 3 * d)).ravel().astype(np.int32)
        begins = np.arange(0, len(entries) + 1, 3 * d, dtype=np.int32)
        shape = len(block) * d, (num_blocks + 1) * d
        self._rows: csr_array = csr_array((np.ones(len(entries)), entries, begins), shape=shape)

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


class BlockFactor:
    """H for one choice of J and W, here in the order of elimination."""

    def __init__(
        self, system: BlockEquations, pattern: _Pattern, rows: csr_array, factor: Cholesky, grounding: float
    ) -> None:
        self._system, self._rank, self._rows = system, pattern.rank, rows
        self._factor, self._grounding = factor, grounding
        self._drawn: np.ndarray | None = None

    @property
    def log_det(self) -> float:
        """Log det H, without what ties the roots down and what is known of loose nodes beforehand."""
        return self._factor.log_det - self._grounding

    @property
    def num_entries(self) -> int:
        """Of the factor."""
        return self._factor.num_entries

    def fit(self, whitened: np.ndarray) -> np.ndarray:
        """Unknowns ``(blocks, d, n)`` that explain whitened rows ``(E + R, d, n)`` best; samples come with them."""
        count = whitened.shape[2]
        ordered: np.ndarray = self._fit(np.concatenate((whitened, self._system.probes), axis=2))
        self._drawn = ordered[:, count:]
        return self._by_block(ordered[:, :count])

    def _fit(self, whitened: np.ndarray) -> np.ndarray:
        """The same in the order of elimination, ``(blocks d, n)``."""
        spend(_SOLVED * self._factor.elimination.units)
        right: np.ndarray = self._rows.T @ whitened.reshape(-1, whitened.shape[2])
        return self._factor.solve(right[: -self._system.size])

    def _by_block(self, ordered: np.ndarray) -> np.ndarray:
        """``(blocks, d, n)``, in which block v stood at its rank."""
        system = self._system
        return np.asarray(ordered.reshape(system.num_blocks, system.size, -1).take(self._rank, axis=0))

    def begun(self, columns: np.ndarray) -> np.ndarray:
        """L⁻¹ of columns ``(blocks, d, n)``, ``(blocks d, n)``: H⁻¹ = L⁻ᵀ L⁻¹."""
        ordered = np.empty_like(columns)
        ordered[self._rank] = columns
        return self._factor.begun(ordered.reshape(len(columns) * self._system.size, -1))

    def ended(self, half: np.ndarray) -> np.ndarray:
        """L⁻ᵀ of what was :meth:`begun` ``(blocks d, n)``, ``(blocks, d, n)``."""
        return self._by_block(self._factor.ended(half))

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Whitened rows ``(E + R, d, n)`` of unknowns ``(blocks, d, n)``."""
        ordered = np.empty_like(unknowns)
        ordered[self._rank] = unknowns
        return self._predicted(ordered.reshape(-1, unknowns.shape[2]))

    def _predicted(self, ordered: np.ndarray) -> np.ndarray:
        d, count = self._system.size, ordered.shape[1]
        padded = np.concatenate((ordered, np.zeros((d, count))))
        return np.asarray((self._rows @ padded).reshape(-1, d, count))

    @property
    def _samples(self) -> np.ndarray:
        if self._drawn is None:
            self._drawn = self._fit(self._system.probes)
        return self._drawn

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
