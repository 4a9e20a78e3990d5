"""The sparse system of the posterior: normal equations of edges between key nodes that may share a common error.

Row e of J says  C_target − C_source + b = r_e,  b the common error of its run; a run's error has a row of its own with
residual 0, its prior. H = Jᵀ W J is factorised once for each choice of weights and gives corrections, log det H and
what everything else predicts of a row.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import coo_array, csc_array, csr_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra.probes import likeliest_leverage, probe_signs
from rotavg_ros.solver.algebra.sparse.laplacian import root_stiffness, solve_in_parts
from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.running.work import ENTRIES, rest, spend, stop_if_abandoned

_NUM_PROBES = 48
# Rows that weigh less than this share of the heaviest one are nothing; so many of them are worth a pattern without
# them, of which some are kept.
_NO_WEIGHT, _WORTH_LEAVING_OUT, _MAX_PARTS = 1e-9, 200, 8
_MAX_LEVERAGE = 1 - 1e-6


class NormalEquations:
    """The pattern of H for E edges between K key nodes and R runs.

    Args:
        num_nodes: K.
        source, target: ``(E,)`` key nodes.
        run: ``(E,)`` column of the common error in 0 … R − 1, or -1.
        sign: ``(E,)`` ±1, the direction in which an edge has it.
        roots: key nodes that stay where they are.
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
        self._whole = _Pattern(self, np.arange(len(column)))
        self._parts: dict[bytes, _Pattern] = {}
        self.probes = probe_signs(
            np.concatenate((source, num_nodes + np.arange(self.num_runs))),
            np.concatenate((target, 2 * num_nodes + self.num_runs + np.arange(self.num_runs))),
            _NUM_PROBES,
        ).astype(np.float64)

    def factorise(self, weight: np.ndarray) -> Factorised:
        """With weights ``(E + R,)``, rad⁻²."""
        stop_if_abandoned()
        pattern = self._pattern(weight)
        spend(pattern.num_entries / ENTRIES)
        stiffness = root_stiffness(weight)
        factor, rank = pattern.factorise(weight, stiffness)
        return Factorised(self, weight, factor, rank, len(self.roots) * np.log(stiffness))

    def _pattern(self, weight: np.ndarray) -> _Pattern:
        """Of the rows that weigh anything: others fill the factor of a graph with many false closures for nothing."""
        counts = weight > _NO_WEIGHT * weight.max()
        if len(weight) - counts.sum() < _WORTH_LEAVING_OUT:
            return self._whole
        key = np.packbits(counts).tobytes()
        if key not in self._parts:
            if len(self._parts) == _MAX_PARTS:
                del self._parts[next(iter(self._parts))]
            # Where nothing else holds a part together, next to nothing does.
            self._parts[key] = _Pattern(self, np.flatnonzero(counts)) if self._is_held(counts) else self._whole
        return self._parts[key]

    def _is_held(self, counts: np.ndarray) -> bool:
        """Whether some rows alone tie every unknown to a root."""
        edges = self.column[: len(self.run)][counts[: len(self.run)]]
        ends = edges[:, 0], edges[:, 1]
        links = coo_array((np.ones(len(edges)), ends), shape=(self.num_nodes,) * 2)
        return bool(connected_components(links, directed=False)[0] == len(self.roots))


class _Pattern:
    """Where the entries of H stand that some of the rows make, in an order of elimination with little fill."""

    def __init__(self, system: NormalEquations, rows: np.ndarray) -> None:
        # Not the system itself, which holds this: both would stay until the garbage collector comes round to them.
        self._rows, self._num_rows, self._size, self._roots = rows, len(system.column), system.size, system.roots
        self._column, self._value = system.column[rows], system.value[rows]
        self._rank = np.arange(system.size)
        self._is_ordered = False
        self._lay_out()

    def _lay_out(self) -> None:
        size = self._size
        column, value = self._rank[self._column], self._value
        first, second = np.repeat(column, 3, axis=1), np.tile(column, 3)
        keys = np.concatenate(((second * size + first).ravel(), self._rank * (size + 1)))
        occupied, slot = np.unique(keys, return_inverse=True)
        slot, diagonal = np.split(slot, [first.size])
        self._root_slot = diagonal[self._roots]
        product = (np.repeat(value, 3, axis=1) * np.tile(value, 3)).ravel()
        row = np.repeat(self._rows, 9)
        # Entries of H as a linear map of the weights.
        self._entries: csr_array = csr_array((product, (slot, row)), shape=(len(occupied), self._num_rows))
        first_of_column = np.searchsorted(occupied, np.arange(size + 1) * size)
        self._matrix: csc_array = csc_array(
            (np.ones(len(occupied)), (occupied % size).astype(np.int32), first_of_column.astype(np.int32)),
            shape=(size, size),
        )

    @property
    def num_entries(self) -> int:
        """Of H."""
        return int(self._matrix.nnz)

    def factorise(self, weight: np.ndarray, stiffness: float) -> tuple[SparseFactor, np.ndarray]:
        """H's factor, and where each unknown stands in it.

        Args:
            weight: ``(E + R,)`` rad⁻².
            stiffness: rad⁻², what ties roots down.
        """
        values = self._entries @ weight
        values[self._root_slot] += stiffness
        self._matrix.data = values
        factor = SparseFactor(self._matrix, is_ordered=self._is_ordered)
        rank = self._rank
        if not self._is_ordered:
            self._rank, self._is_ordered = factor.rank, True
            self._lay_out()
        return factor, rank


class Factorised:
    """H for one choice of weights."""

    def __init__(
        self, system: NormalEquations, weight: np.ndarray, factor: SparseFactor, rank: np.ndarray, grounding: float
    ) -> None:
        self.system, self.weight = system, weight
        self._factor, self._rank, self._node, self._grounding = factor, rank, np.argsort(rank), grounding

    @property
    def log_det(self) -> float:
        """Log det H, without the rows that tie the roots down."""
        return self._factor.log_det - self._grounding

    @property
    def num_entries(self) -> int:
        """Of the factor."""
        return self._factor.num_entries

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``H⁻¹ b`` for ``(K + R, k)`` columns."""
        stop_if_abandoned()
        rest()
        return solve_in_parts(self._factor, right_hand_side.take(self._node, axis=0)).take(self._rank, axis=0)

    def fit(self, difference: np.ndarray) -> np.ndarray:
        """Unknowns ``(K + R, k)`` that explain ``(E + R, k)`` best."""
        return self.solve(self.system._transposed @ (self.weight[:, None] * difference))

    @cached_property
    def samples(self) -> np.ndarray:
        """Unknowns ``(K + R, 48)`` whose second moments are H⁻¹."""
        return self.fit(self.system.probes / np.sqrt(self.weight)[:, None])

    @cached_property
    def resistance(self) -> np.ndarray:
        """``(E + R,)`` rad², variance of what the fit says of every row, estimated by samples."""
        scaled = np.sqrt(self.weight)[:, None] * (self.system.rows @ self.samples)
        probes = self.system.probes
        leverage = likeliest_leverage((scaled**2).mean(axis=1), (scaled * probes).mean(axis=1))
        return np.asarray(np.minimum(leverage, _MAX_LEVERAGE) / self.weight)

    def covariance(self, rows: np.ndarray) -> np.ndarray:
        """``(n, n)`` rad², exact, of what the fit says of some rows."""
        chosen = self.system.rows[rows]
        columns = np.zeros((self.system.size, len(rows)))
        np.add.at(columns, (self.system.column[rows], np.arange(len(rows))[:, None]), self.system.value[rows])
        return np.asarray(chosen @ self.solve(columns))
