"""The sparse system of the posterior: normal equations of edges between key nodes that may share a common error.

Row e of J says  C_target − C_source + b = r_e,  with b the common error of its run. A run's error has a row of its own
with residual 0, its prior. H = Jᵀ W J is factorised once for each choice of weights. It gives corrections, log det H
and the prediction of each row by all others.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra.sparse.laplacian import root_stiffness
from rotavg_ros.solver.algebra.sparse.ldl import LDL, RowPattern
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import ENTRIES, rest, spend, stop_if_abandoned

# Rows that weigh less than this share of the heaviest one are left out.
_NO_WEIGHT = 1e-9
# Number of row patterns that are kept. A pattern reuses another's elimination order if it lacks at most this share of
# its rows and has at most this many rows more: missing rows cause no fill-in, additional ones may cause much.
_MAX_PATTERNS, _LACKING, _MORE = 8, 0.02, 3
_MAX_LEVERAGE = 1 - 1e-6


class NormalEquations:
    """The pattern of H for E edges between K key nodes and R runs.

    Args:
        num_nodes: K.
        source, target: ``(E,)`` key nodes.
        run: ``(E,)`` column of the common error in 0 … R − 1, or -1.
        sign: ``(E,)`` ±1, sign of the common error in each edge.
        roots: key nodes that are held fixed.
    """

    def __init__(
        self,
        num_nodes: int,
        source: np.ndarray,
        target: np.ndarray,
        run: np.ndarray,
        sign: np.ndarray,
        roots: np.ndarray,
    ) -> None:
        self.num_nodes, self.num_runs = num_nodes, int(run.max(initial=-1)) + 1
        self.roots, self.run, self.sign = roots, run, sign
        self.shared = has_run = run >= 0
        column = np.concatenate(
            (
                np.stack((target, source, np.where(has_run, num_nodes + run, target)), axis=1),
                np.repeat(num_nodes + np.arange(self.num_runs)[:, None], 3, axis=1),
            )
        )
        value = np.concatenate(
            (
                np.stack((np.ones(len(source)), -np.ones(len(source)), np.where(has_run, sign, 0.0)), axis=1),
                np.tile([1.0, 0.0, 0.0], (self.num_runs, 1)),
            )
        )
        self.column, self.value = column, value
        self.size = num_nodes + self.num_runs
        rows = np.repeat(np.arange(len(column)), 3)
        self.rows: csr_array = csr_array((value.ravel(), (rows, column.ravel())), shape=(len(column), self.size))
        self._transposed = self.rows.T.tocsr()
        self._whole = np.ones(len(column), dtype=bool)
        self._patterns: dict[bytes, _Pattern] = {}
        self._ordered: list[_Pattern] = []

    def factorise(self, weight: np.ndarray) -> Factorised:
        """With weights ``(E + R,)``, rad⁻²."""
        stop_if_abandoned()
        pattern = self._pattern(weight)
        spend(pattern.rows.num_entries / ENTRIES + pattern.rows.units)
        stiffness = root_stiffness(weight)
        extra = np.zeros(self.size)
        extra[self.roots] = stiffness
        factor = pattern.rows.factorise(weight[pattern.counts], extra)
        return Factorised(self, weight, pattern, factor, len(self.roots) * np.log(stiffness))

    def _pattern(self, weight: np.ndarray) -> _Pattern:
        """The pattern of rows of non-zero weight; with many false closures, the others would only add fill-in."""
        counts = weight > _NO_WEIGHT * weight.max(initial=0.0)
        key = np.packbits(counts).tobytes()
        if key not in self._patterns:
            if len(self._patterns) == _MAX_PATTERNS:
                del self._patterns[next(iter(self._patterns))]
            # If the kept rows leave a part loose, all rows are used, even those of negligible weight.
            self._patterns[key] = self._laid_out(counts if self._is_held(counts) else self._whole)
        return self._patterns[key]

    def _laid_out(self, counts: np.ndarray) -> _Pattern:
        """The pattern of some rows, in the elimination order of a similar one if there is any."""
        alike = next((other for other in self._ordered if _is_eliminated_alike(counts, other.counts)), None)
        rank = None if alike is None else alike.rows.rank
        pattern = _Pattern(counts, RowPattern(self.column[counts], self.value[counts], self.size, rank))
        if alike is None:
            self._ordered = [pattern, *self._ordered[: _MAX_PATTERNS - 1]]
        return pattern

    def _is_held(self, counts: np.ndarray) -> bool:
        """Whether some rows alone tie every unknown to a root."""
        edges = self.column[: len(self.run)][counts[: len(self.run)]]
        ends = edges[:, 0], edges[:, 1]
        links = coo_array((np.ones(len(edges)), ends), shape=(self.num_nodes,) * 2)
        return bool(connected_components(links, directed=False)[0] == len(self.roots))


class _Pattern(NamedTuple):
    """The pattern of some of the rows.

    Attributes:
        counts: ``(E + R,)`` bool, which rows these are.
        rows: positions of the entries of H and its factor.
    """

    counts: np.ndarray
    rows: RowPattern


def _is_eliminated_alike(counts: np.ndarray, others: np.ndarray) -> bool:
    """Whether some rows ``(E + R,)`` bool cause little fill-in in the elimination order of others."""
    more, lacking = np.count_nonzero(counts & ~others), np.count_nonzero(others & ~counts)
    return bool(more <= _MORE and lacking <= _LACKING * len(counts))


class Factorised:
    """H for one choice of weights.

    Attributes:
        system: its pattern.
        weight: ``(E + R,)`` rad⁻².
    """

    def __init__(
        self, system: NormalEquations, weight: np.ndarray, pattern: _Pattern, factor: LDL, grounding: float
    ) -> None:
        self.system, self.weight = system, weight
        self._counts, self._factor, self._grounding = pattern.counts, factor, grounding

    @property
    def log_det(self) -> float:
        """Log det H, without the rows that tie the roots down."""
        return self._factor.log_det - self._grounding

    @property
    def num_entries(self) -> int:
        """Number of entries of the factor."""
        return self._factor.pattern.num_factor_entries

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``H⁻¹ b`` for ``(K + R, k)`` columns."""
        stop_if_abandoned()
        rest()
        return self._factor.solve(right_hand_side)

    def fit(self, difference: np.ndarray) -> np.ndarray:
        """Least-squares unknowns ``(K + R, k)`` for differences ``(E + R, k)``."""
        return self.solve(self.gradient(difference))

    def gradient(self, difference: np.ndarray) -> np.ndarray:
        """``Jᵀ W r`` ``(K + R, k)`` of ``(E + R, k)`` residuals."""
        return np.asarray(self.system._transposed @ (self.weight[:, None] * difference))

    @property
    def variance(self) -> np.ndarray:
        """``(K + R,)`` rad², of every unknown."""
        return self._factor.variance

    @cached_property
    def resistance(self) -> np.ndarray:
        """``(E + R,)`` rad², variance of the fitted value of every row."""
        variance, left_out = self.resistance_of_kept.copy(), ~self._counts
        far = self._factor.variance_of(self.system.column[left_out], self.system.value[left_out])
        variance[left_out] = np.minimum(far, _MAX_LEVERAGE / self.weight[left_out])
        return np.asarray(variance)

    @cached_property
    def resistance_of_kept(self) -> np.ndarray:
        """The same, but NaN for rows of no weight, which takes less time."""
        variance = np.full(len(self.weight), np.nan)
        variance[self._counts] = np.minimum(self._factor.row_variance, _MAX_LEVERAGE / self.weight[self._counts])
        return variance

    def covariance(self, rows: np.ndarray) -> np.ndarray:
        """``(n, n)`` rad², covariance of the fitted values of some rows."""
        chosen = self.system.rows[rows]
        columns = np.zeros((self.system.size, len(rows)))
        np.add.at(columns, (self.system.column[rows], np.arange(len(rows))[:, None]), self.system.value[rows])
        return np.asarray(chosen @ self.solve(columns))
