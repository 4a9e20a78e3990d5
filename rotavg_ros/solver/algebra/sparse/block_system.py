"""The sparse system of poses in a pose graph: one block of unknowns per node.

A node's block is its turn (k components) and its shift (m). A run's block is the common error of its closures. The
three blocks of a row are those of its target, its source and its run. H = Jᵀ W J is factorised once for each choice
of J and W. Its inverse between a row's blocks gives the covariance that all rows predict for this row. Rows of
negligible weight are left out of H's pattern; their covariance is estimated from samples of N(0, H⁻¹).
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra.products import product
from rotavg_ros.solver.algebra.small_matrices import inverse
from rotavg_ros.solver.algebra.sparse.block_rows import (
    covariance_of_rows,
    exceed,
    gradient,
    normal_matrix,
    predicted_rows,
)
from rotavg_ros.solver.algebra.sparse.elimination import Elimination
from rotavg_ros.solver.algebra.sparse.multifrontal import Cholesky
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import spend, stop_if_abandoned

_NUM_SAMPLES, _SEED = 48, 0
# Work of a solve for one column relative to that of the factor.
_SOLVED = 0.1
# A row is negligible if it has less than this share of all rows' information about each of its blocks; number of
# negligible rows from which a pattern without them pays off.
_NEXT_TO_NOTHING, _WORTH_LEAVING_OUT = 1e-8, 200
# Least share of a row that the others determine, also where no other row does; and the share below which the row nearly
# determines itself.
_LEAST, _NEARLY = 1e-9, 1e-4
_NOWHERE = -1
# Units of work per row, for the positions of its products, and for the products.
_ROW = 0.001


class BlockEquations:
    """The pattern of H for E rows between K nodes and R runs, d unknowns each.

    Args:
        size: (k, m) with d = k + m, components of a turn and of a shift.
        num_nodes: K.
        ends: ``(E, 2)`` sources and targets.
        run: ``(E,)`` in 0 … R − 1, or -1.
        roots: nodes that stay where they are.
        loose: nodes that have a prior: the first ones of chains that odometry does not tie to a root.
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
        self.size, self.num_edges = sum(size), len(ends)
        self.num_blocks, self.roots, self.loose = num_nodes + num_runs, roots, loose
        source, target = ends.T
        block = np.stack((target, source, np.where(run >= 0, num_nodes + run, _NOWHERE)), axis=1)
        of_runs = np.stack((num_nodes + np.arange(num_runs), *[np.full(num_runs, _NOWHERE)] * 2), axis=1)
        self.block = np.concatenate((block, of_runs))
        self._pattern: _Pattern | None = None

    def factorise(
        self, jacobian: np.ndarray, root_weight: np.ndarray, loose_weight: np.ndarray | None = None
    ) -> BlockFactor:
        """Factorise H of whitened rows.

        Args:
            jacobian: ``(E + R, d, 3 d)`` W^½ J.
            root_weight: ``(d,)`` weight that ties roots down.
            loose_weight: ``(d,)`` weight of the loose nodes' prior; None: they have none.
        """
        stop_if_abandoned()
        pattern = self._pattern_of(jacobian)
        spend(_ROW * len(jacobian))
        entries = normal_matrix(
            np.ascontiguousarray(jacobian[pattern.kept]),
            pattern.place[pattern.kept],
            pattern.slot,
            pattern.elimination.num_entries,
        )
        entries[pattern.diagonal] += np.finfo(np.float64).tiny
        entries[pattern.diagonal[self.roots]] += root_weight
        grounding = len(self.roots) * np.log(root_weight).sum()
        if loose_weight is not None:
            entries[pattern.diagonal[self.loose]] += loose_weight
            grounding += len(self.loose) * np.log(loose_weight).sum()
        factor = Cholesky(pattern.elimination, entries)
        return BlockFactor(pattern, np.ascontiguousarray(jacobian), factor, float(grounding))

    def _pattern_of(self, jacobian: np.ndarray) -> _Pattern:
        """Pattern of the rows of non-zero weight; with many false closures, the others would only add fill-in."""
        counts = self._count(jacobian)
        pattern = self._pattern
        if pattern is None or not pattern.covers(counts):
            pattern = self._pattern = _Pattern(self, counts)
        return pattern

    def _count(self, jacobian: np.ndarray) -> np.ndarray:
        """``(E + R,)`` bool, rows that are not negligible, see :data:`_NEXT_TO_NOTHING`.

        All rows, unless many are negligible and the others leave the graph in as many parts.
        """
        d, num_blocks = self.size, self.num_blocks
        told = (jacobian**2).sum(axis=1).reshape(-1, 3, d).max(axis=2)
        block = np.where(self.block >= 0, self.block, num_blocks)
        of_block = np.bincount(block.ravel(), told.ravel(), num_blocks + 1)
        of_block[num_blocks] = np.inf
        counts: np.ndarray = (told > _NEXT_TO_NOTHING * of_block[block]).any(axis=1)
        is_worth = len(counts) - counts.sum() >= _WORTH_LEAVING_OUT
        everything = np.ones_like(counts)
        return counts if is_worth and self._num_parts(counts) == self._num_parts(everything) else everything

    def _num_parts(self, counts: np.ndarray) -> int:
        """Number of connected parts of the graph with these rows only; runs connect nothing, since each has a prior."""
        target, source = self.block[: self.num_edges][counts[: self.num_edges], :2].T
        links = coo_array((np.ones(len(target)), (target, source)), shape=(self.num_blocks,) * 2)
        return int(connected_components(links, directed=False)[0])


class _Pattern:
    """Positions of rows' products in H, in the order of elimination.

    Args:
        equations: of B blocks and rows with blocks ``(E + R, 3)``.
        counts: ``(E + R,)`` bool, rows that contribute to H.

    Attributes:
        counts, kept: those rows, as given and as indices.
        elimination: of H.
        place: ``(E + R, 3)`` positions of each row's blocks in the order of elimination, or -1.
        slot: ``(rows kept, 3, 3)`` where H's entries of each pair of a row's blocks begin, the same in either order.
        diagonal: ``(B, d)`` positions of H's diagonal entries.
    """

    def __init__(self, equations: BlockEquations, counts: np.ndarray) -> None:
        self.counts, self.kept = counts, np.flatnonzero(counts)
        d, num_blocks = equations.size, equations.num_blocks
        blocks = equations.block[self.kept]
        first, second = (ends.ravel() for ends in np.broadcast_arrays(blocks[:, :, None], blocks[:, None, :]))
        pair = np.flatnonzero((first >= 0) & (second >= 0))
        first, second = first[pair], second[pair]
        self.elimination = Elimination(first, second, num_blocks, d)
        self.rank = self.elimination.rank
        spend(_ROW * len(blocks))
        lower = np.minimum(self.rank[first], self.rank[second])
        upper = np.maximum(self.rank[first], self.rank[second])
        slot = np.full(9 * len(blocks), _NOWHERE)
        slot[pair] = self.elimination.corners(lower, upper)
        self.slot = slot.reshape(-1, 3, 3)
        self.diagonal = self.elimination.corners(self.rank, self.rank)[:, None] + np.arange(d) * (d + 1)
        self.place = np.where(equations.block >= 0, self.rank[equations.block], _NOWHERE)

    def covers(self, counts: np.ndarray) -> bool:
        """Whether it has all of these rows and few others."""
        missing, needless = counts & ~self.counts, self.counts & ~counts
        return not missing.any() and int(needless.sum()) < _WORTH_LEAVING_OUT


class BlockFactor:
    """H for one choice of J and W."""

    def __init__(self, pattern: _Pattern, jacobian: np.ndarray, factor: Cholesky, grounding: float) -> None:
        self._pattern, self._jacobian = pattern, jacobian
        self._factor, self._grounding = factor, grounding

    @property
    def log_det(self) -> float:
        """Log det H, without the weights of roots and of loose nodes."""
        return self._factor.log_det - self._grounding

    @property
    def num_entries(self) -> int:
        """Number of entries of the factor."""
        return self._factor.num_entries

    def fit(self, whitened: np.ndarray) -> np.ndarray:
        """Unknowns ``(blocks, d, n)`` that explain whitened rows ``(E + R, d, n)`` best."""
        place, elimination = self._pattern.place, self._factor.elimination
        units = _SOLVED * whitened.shape[2] * elimination.units
        right = gradient(self._jacobian, place, np.ascontiguousarray(whitened), elimination.num_blocks)
        return self._by_block(self._factor.solve(right.reshape(-1, whitened.shape[2]), units))

    def _by_block(self, ordered: np.ndarray) -> np.ndarray:
        """``(blocks, d, n)`` by block, of what is in the order of elimination."""
        elimination = self._factor.elimination
        by_place = ordered.reshape(elimination.num_blocks, elimination.size, -1)
        return np.asarray(by_place.take(elimination.rank, axis=0))

    def begun(self, columns: np.ndarray) -> np.ndarray:
        """``(blocks d, n)`` U⁻ᵀ of columns ``(blocks, d, n)``, where H⁻¹ = U⁻¹ U⁻ᵀ."""
        ordered = np.empty_like(columns)
        ordered[self._pattern.rank] = columns
        return self._factor.begun(ordered.reshape(-1, columns.shape[2]))

    def ended(self, half: np.ndarray) -> np.ndarray:
        """``(blocks, d, n)`` U⁻¹ of ``(blocks d, n)`` that :meth:`begun` returned."""
        return self._by_block(self._factor.ended(half))

    def predicted(self, unknowns: np.ndarray) -> np.ndarray:
        """Whitened rows ``(E + R, d, n)`` that unknowns ``(blocks, d, n)`` predict."""
        ordered = np.empty_like(unknowns)
        ordered[self._pattern.rank] = unknowns
        return predicted_rows(self._jacobian, self._pattern.place, ordered)

    @property
    def variance(self) -> np.ndarray:
        """``(blocks, d)`` diagonal of H⁻¹."""
        return self._factor.inverse[self._pattern.diagonal]

    @cached_property
    def _samples(self) -> np.ndarray:
        """``(blocks, d, 48)`` drawn from N(0, H⁻¹), in the order of elimination."""
        elimination = self._factor.elimination
        shape = elimination.num_blocks, elimination.size, _NUM_SAMPLES
        units = _SOLVED * _NUM_SAMPLES * elimination.units / 2
        drawn = np.random.default_rng(_SEED).standard_normal(shape)
        return self._factor.ended(drawn.reshape(-1, _NUM_SAMPLES), units).reshape(shape)

    def covariance(self, jacobian: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Covariance ``(n, d, d)`` of J x, x ~ N(0, H⁻¹); J ``(n, d, 3 d)`` is for the blocks of rows ``(n,)``."""
        pattern, found = self._pattern, np.empty((len(row), *jacobian.shape[1:2] * 2))
        number = np.cumsum(pattern.counts) - 1
        is_kept = pattern.counts[row]
        slot = pattern.slot[number[row[is_kept]]]
        place = pattern.place[row]
        found[is_kept] = covariance_of_rows(jacobian[is_kept], place[is_kept], slot, self._factor.inverse)
        if not is_kept.all():
            drawn = predicted_rows(jacobian[~is_kept], place[~is_kept], self._samples)
            found[~is_kept] = np.matmul(drawn, drawn.transpose(0, 2, 1)) / _NUM_SAMPLES
        return found

    def covariance_between(self, jacobian: np.ndarray, row: np.ndarray) -> np.ndarray:
        """Joint covariance ``(n d, n d)`` of some rows; arguments as of :meth:`covariance`."""
        count, d, _ = jacobian.shape
        elimination, place = self._factor.elimination, self._pattern.place[row]
        columns = np.zeros((elimination.num_blocks, d, count, d))
        for third in range(3):
            has = np.flatnonzero(place[:, third] >= 0)
            part = jacobian[has, :, third * d : (third + 1) * d]
            columns[place[has, third], :, has] += part.transpose(0, 2, 1)
        half = self._factor.begun(columns.reshape(elimination.num_blocks * d, -1))
        return product(half.T, half)

    @property
    def leverage(self) -> np.ndarray:
        """``(E + R, d, d)`` Λ = W^½ J H⁻¹ Jᵀ W^½, the share of a whitened row that its own measurement determines."""
        return self._shares[0]

    @property
    def redundancy(self) -> np.ndarray:
        """``(E + R, d, d)`` I − Λ, positive definite."""
        return self._shares[1]

    @cached_property
    def _shares(self) -> tuple[np.ndarray, np.ndarray]:
        unit = np.eye(self._jacobian.shape[1])
        leverage = self.covariance(self._jacobian, np.arange(len(self._jacobian)))
        redundancy = unit - leverage
        # Both are positive definite but for rounding.
        low = np.flatnonzero(~(exceed(redundancy, _LEAST) & exceed(leverage, -_LEAST)))
        value, vector = np.linalg.eigh(redundancy[low])
        value = np.clip(value, _LEAST, 1.0)[:, None]
        redundancy[low] = np.matmul(vector * value, vector.transpose(0, 2, 1))
        leverage[low] = np.matmul(vector * (1 - value), vector.transpose(0, 2, 1))
        return leverage, redundancy

    def without(self, row: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Of rows ``(n,)``: (I − Λ)⁻¹, and (I − Λ)⁻¹ Λ, the covariance predicted by the others; ``(n, d, d)`` each."""
        redundancy = self.redundancy[row]
        others = inverse(redundancy)
        covariance = np.matmul(others, self.leverage[row])
        # Where a row nearly determines itself, the product is a small difference of large numbers.
        low = np.flatnonzero(~exceed(redundancy, _NEARLY))
        value, vector = np.linalg.eigh(redundancy[low])
        value = np.clip(value, _LEAST, 1.0)[:, None]
        others[low] = np.matmul(vector / value, vector.transpose(0, 2, 1))
        covariance[low] = np.matmul(vector * (1 - value) / value, vector.transpose(0, 2, 1))
        return others, (covariance + covariance.transpose(0, 2, 1)) / 2
