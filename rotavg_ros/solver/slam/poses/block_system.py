"""The sparse system of poses: as :mod:`rotavg_ros.solver.slam.posterior.system`, with a block of unknowns a node.

A node's block is its turn (k components) and its shift (m), a run's block what its closures err in common. The three
blocks of a row are those of its target, its source and its run. H = Jᵀ W J is factorised once for each choice of J
and W; samples of N(0, H⁻¹) tell what everything else predicts of a row.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from scipy.sparse import csc_array
from scipy.sparse.linalg import SuperLU, splu

from rotavg_ros.solver.algebra.abandonment import stop_if_abandoned
from rotavg_ros.solver.algebra.laplacian import solve_in_parts

_NUM_PROBES, _SEED = 48, 0
# SuperLU merges no columns of unlike pattern: blocks are dense as they are, and merging fills in, on a sphere sixfold.
_RELAX, _PANEL = 1, 4
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
    """

    def __init__(
        self, size: tuple[int, int], num_nodes: int, ends: np.ndarray, run: np.ndarray, roots: np.ndarray
    ) -> None:
        num_runs = int(run.max(initial=-1)) + 1
        self.turns, self.size = size[0], sum(size)
        self.num_blocks, self.roots = num_nodes + num_runs, roots
        nowhere = self.num_blocks
        source, target = ends.T
        self.block = np.stack((target, source, np.where(run >= 0, num_nodes + run, nowhere)), axis=1)
        self.block = np.concatenate(
            (self.block, np.stack((num_nodes + np.arange(num_runs), *[np.full(num_runs, nowhere)] * 2), axis=1))
        )
        # Sums over rows go block by block: in this order, from these places on.
        self._by_block = np.argsort(self.block.ravel(), kind="stable")
        self._used_blocks, self._first = np.unique(self.block.ravel()[self._by_block], return_index=True)
        self._rank = np.arange(self.num_blocks * self.size)
        self._is_ordered = False
        self._lay_out()
        self.probes = np.random.default_rng(_SEED).standard_normal((len(self.block), self.size, _NUM_PROBES))

    def _lay_out(self) -> None:
        d, count = self.size, self.num_blocks * self.size
        rank = np.concatenate((self._rank, np.full(d, -1)))
        column = rank[(self.block[:, :, None] * d + np.arange(d)).reshape(len(self.block), 3 * d)]
        row, col = np.repeat(column, 3 * d, axis=1).ravel(), np.tile(column, 3 * d).ravel()
        self._is_used = (row >= 0) & (col >= 0)
        keys = np.concatenate((col[self._is_used] * count + row[self._is_used], np.arange(count) * (count + 1)))
        occupied, slot = np.unique(keys, return_inverse=True)
        self._slot, self._diagonal = slot[: len(keys) - count], slot[len(keys) - count :]
        first = np.searchsorted(occupied, np.arange(count + 1) * count)
        self._num_entries = len(occupied)
        self._matrix: csc_array = csc_array(
            (np.ones(len(occupied)), (occupied % count).astype(np.int32), first.astype(np.int32)), shape=(count, count)
        )

    def factorise(self, jacobian: np.ndarray, root_weight: np.ndarray) -> BlockFactor:
        """Of whitened rows.

        Args:
            jacobian: ``(E + R, d, 3 d)`` W^½ J.
            root_weight: what ties roots down, ``(d,)``.
        """
        stop_if_abandoned()
        blocks = np.matmul(jacobian.transpose(0, 2, 1), jacobian).ravel()[self._is_used]
        values = np.bincount(self._slot, blocks, self._num_entries)
        values[self._diagonal] += np.finfo(np.float64).tiny
        d = self.size
        values[self._diagonal[self._rank[self.roots[:, None] * d + np.arange(d)]]] += root_weight
        self._matrix.data = values
        options = {"SymmetricMode": True}
        order = "NATURAL" if self._is_ordered else "MMD_AT_PLUS_A"
        factor = splu(self._matrix, order, 0.0, relax=_RELAX, panel_size=_PANEL, options=options)
        rank = self._rank
        if not self._is_ordered:
            self._rank, self._is_ordered = factor.perm_c.astype(np.int64)[self._rank], True
            self._lay_out()
        return BlockFactor(self, jacobian, factor, rank, len(self.roots) * float(np.log(root_weight).sum()))


class BlockFactor:
    """H for one choice of J and W."""

    def __init__(
        self, system: BlockEquations, jacobian: np.ndarray, factor: SuperLU, rank: np.ndarray, grounding: float
    ) -> None:
        self._system, self._jacobian, self._factor, self._rank = system, jacobian, factor, rank
        self._place, self._grounding = np.argsort(rank), grounding

    @property
    def log_det(self) -> float:
        """Log det H, without what ties the roots down."""
        return float(np.log(np.abs(self._factor.U.diagonal())).sum()) - self._grounding

    def fit(self, whitened: np.ndarray) -> np.ndarray:
        """Unknowns ``(blocks, d, n)`` that explain whitened rows ``(E + R, d, n)`` best."""
        stop_if_abandoned()
        system, d = self._system, self._system.size
        parts = np.matmul(self._jacobian.transpose(0, 2, 1), whitened).reshape(-1, d, whitened.shape[2])
        right = np.zeros((system.num_blocks + 1, d, whitened.shape[2]))
        right[system._used_blocks] = np.add.reduceat(parts[system._by_block], system._first, axis=0)
        columns = right[:-1].reshape(-1, whitened.shape[2])
        solved = solve_in_parts(self._factor, columns.take(self._place, axis=0)).take(self._rank, axis=0)
        return np.asarray(solved.reshape(system.num_blocks, d, -1))

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Whitened rows ``(E + R, d, n)`` of unknowns ``(blocks, d, n)``."""
        padded = np.concatenate((unknowns, np.zeros((1, *unknowns.shape[1:]))))
        d = self._system.size
        return np.asarray(np.matmul(self._jacobian, padded[self._system.block].reshape(-1, 3 * d, unknowns.shape[2])))

    @cached_property
    def samples(self) -> np.ndarray:
        """Unknowns ``(blocks, d, 48)`` drawn from N(0, H⁻¹)."""
        return self.fit(self._system.probes)

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
        taken = self.predicted(self.samples)
        left = self._system.probes - taken
        moments = [np.matmul(part, part.transpose(0, 2, 1)) / _NUM_PROBES for part in (taken, left)]
        both = moments[0] + moments[1]
        # A turn's moments with a shift's are noise where one of the two hardly counts, and it is as slight as that in y
        # or in z − y by itself, but not in their sum: nothing of the one's leverage may get into the other's.
        both[:, :k, k:] = both[:, k:, :k] = 0
        root = np.linalg.inv(np.linalg.cholesky(both))
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
    return np.asarray(1 / np.trace(np.linalg.inv(matrix), axis1=1, axis2=2))
