"""Weighted graph Laplacians: one sparse factorisation, many right-hand sides.

Residuals are rotations of the world frame. Where noise has the same variance about every axis, an edge's weight is a
scalar, and the three components of a correction share one scalar Laplacian ``L = Bᵀ W B``, grounded at the roots (one
per connected component). SfM's shaped steps weigh edges by 3 × 3 matrices: ``sfm/laplacians/block.py``.

A solve factorises the same pattern with many choices of weights. What depends only on the pattern is computed once: the
order of elimination, the positions of the weights, and Bᵀ.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np
from scipy.linalg import cho_solve
from scipy.sparse import csc_array, csr_array

from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor
from rotavg_ros.solver.running.work import stop_if_abandoned

# How much stiffer than its own edges a root is tied to zero.
_GROUNDING = 1e6
# A graph with more than this share of all pairs, and more than this many edges per node, fills in completely, and dense
# Cholesky is then many times faster. With fewer it is no faster, however small the graph: OpenBLAS spreads it over the
# cores, which wait for each other longer than they work.
_DENSE_SHARE, _DENSE_EDGES_PER_NODE = 0.01, 8
_DENSE_MAX_NODES = 5000
# From eight columns on, SuperLU's many small products are large enough for OpenBLAS to spread each over the cores,
# which costs more than it saves: 48 columns on 8600 nodes took 180 ms of CPU time at once and 28 ms in fours.
# Six columns stay on one thread only in smaller graphs: ticks of 10 000 keyframes took twice the CPU time with six.
_COLUMNS_AT_ONCE = 4


def incidence_matrix(num_nodes: int, source: np.ndarray, target: np.ndarray) -> csr_array:
    """Bᵀ ``(N, E)``: column e has 1 at the target of edge e and -1 at its source."""
    columns = np.stack((target, source), axis=1).ravel()
    shape = num_nodes, len(source)
    by_edge = csc_array((np.tile([1.0, -1.0], len(source)), columns, np.arange(0, 2 * len(source) + 1, 2)), shape=shape)
    return csr_array(by_edge)


def root_stiffness(weight: np.ndarray) -> float:
    """How stiffly roots are tied to zero in a graph with weights ``(E,)``."""
    return _GROUNDING * max(float(weight.max(initial=0.0)), 1.0)


class LaplacianPattern:
    """A graph whose Laplacian is factorised for one choice of weights after another.

    Args:
        num_nodes: N.
        source, target: ``(E,)`` ends of the edges.
        roots: one node of each connected component; their solution is zero.
    """

    def __init__(self, num_nodes: int, source: np.ndarray, target: np.ndarray, roots: np.ndarray) -> None:
        self.num_nodes, self.source, self.target, self.roots = num_nodes, source, target, roots
        self._incidence = incidence_matrix(num_nodes, source, target)
        # Position of each node in the order of elimination, which the first factorisation finds.
        self._rank: np.ndarray | None = None
        self._lay_out(np.arange(num_nodes))

    def _lay_out(self, rank: np.ndarray) -> None:
        """Find where weights and degrees go in a matrix in compressed columns, rows and columns ordered by ``rank``."""
        row, column = rank[np.concatenate((self.source, self.target))], rank[np.concatenate((self.target, self.source))]
        keys = np.concatenate((column * self.num_nodes + row, rank * (self.num_nodes + 1)))
        occupied, slot = np.unique(keys, return_inverse=True)
        off_diagonal, diagonal = np.split(slot, [2 * len(self.source)])
        self._slot = np.concatenate((off_diagonal, diagonal[self.source], diagonal[self.target]))
        self._root_slot = diagonal[self.roots]
        self._row = (occupied % self.num_nodes).astype(np.int32)
        self._first = np.searchsorted(occupied, np.arange(self.num_nodes + 1) * self.num_nodes).astype(np.int32)

    def factorize(self, weight: np.ndarray) -> FactorisedLaplacian:
        """The system with positive weights ``(E,)``; a node reached by tiny weights alone stays solvable."""
        stop_if_abandoned()
        matrix = self._matrix(weight)
        num_edges, num_nodes = len(self.source), self.num_nodes
        is_dense = num_edges > max(_DENSE_SHARE * num_nodes**2 / 2, _DENSE_EDGES_PER_NODE * num_nodes)
        if is_dense and num_nodes <= _DENSE_MAX_NODES:
            # Weights that span all of double precision can leave no positive pivot; the sparse factorisation copes.
            with suppress(np.linalg.LinAlgError):
                # SciPy's cho_factor would keep Python's global lock, and with it every other thread, for seconds.
                lower = np.linalg.cholesky(matrix.toarray())
                factor = partial(cho_solve, (lower.T, False))
                return FactorisedLaplacian(self._incidence, weight, factor)
        return FactorisedLaplacian(self._incidence, weight, self._factorize_sparse(matrix))

    def _matrix(self, weight: np.ndarray) -> csc_array:
        """``L``, rows and columns in the order of elimination as far as it is known."""
        values = np.bincount(self._slot, np.concatenate((-weight, -weight, weight, weight)), len(self._row))
        # NumPy counts an empty array in integers, even with weights.
        values = values.astype(np.float64, copy=False)
        values[self._root_slot] += root_stiffness(weight)
        return csc_array((values, self._row, self._first), shape=(self.num_nodes, self.num_nodes))

    def _factorize_sparse(self, matrix: csc_array) -> Callable[[np.ndarray], np.ndarray]:
        """A function that solves with the factor."""
        is_ordered = self._rank is not None
        factor = SparseFactor(matrix, is_ordered=is_ordered)
        rank = np.arange(self.num_nodes) if self._rank is None else self._rank
        if not is_ordered:
            # This matrix is in the nodes' own order; later ones are in the order of elimination.
            self._rank = factor.rank
            self._lay_out(self._rank)
        return partial(_solve_sparse, factor, np.argsort(rank), rank)


def _solve_sparse(factor: SparseFactor, node: np.ndarray, rank: np.ndarray, right_hand_side: np.ndarray) -> np.ndarray:
    """Solve ``(N, k)`` columns; the matrix has ``node[i]`` in row i, and node v in row ``rank[v]``."""
    return solve_in_parts(factor, right_hand_side.take(node, axis=0)).take(rank, axis=0)


def solve_in_parts(factor: SparseFactor, right_hand_side: np.ndarray) -> np.ndarray:
    """Solve ``(N, k)`` columns, a few at a time."""
    columns = np.asfortranarray(right_hand_side)
    starts = range(0, columns.shape[1], _COLUMNS_AT_ONCE)
    parts = [factor.solve(columns[:, start : start + _COLUMNS_AT_ONCE]) for start in starts]
    return np.concatenate(parts, axis=1) if parts else columns


class FactorisedLaplacian:
    """``L`` for one choice of weights.

    Args:
        incidence: Bᵀ, ``(N, E)``.
        weight: ``(E,)``.
        solve: ``L⁻¹ b`` for ``(N, k)`` columns.
    """

    def __init__(
        self,
        incidence: csr_array,
        weight: np.ndarray,
        solve: Callable[[np.ndarray], np.ndarray],
    ) -> None:
        self._incidence, self.weight, self._solve = incidence, weight, solve

    def incidence_sum(self, edge_values: np.ndarray) -> np.ndarray:
        """``Bᵀ x``: at every node the values ``(E, k)`` of edges that end there, less those that start there."""
        return np.asarray(self._incidence @ edge_values)

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``L⁻¹ b`` for ``(N, k)`` columns."""
        stop_if_abandoned()
        return np.asarray(self._solve(right_hand_side))

    def fit(self, difference: np.ndarray) -> np.ndarray:
        """Node values ``(N, k)`` whose differences target − source fit ``difference`` ``(E, k)`` best."""
        return self.solve(self.incidence_sum(self.weight[:, None] * difference))


class LaplacianSystem(FactorisedLaplacian):
    """A graph that is factorised once; the arguments are those of :class:`LaplacianPattern` and the weights."""

    def __init__(
        self, num_nodes: int, source: np.ndarray, target: np.ndarray, weight: np.ndarray, roots: np.ndarray
    ) -> None:
        once = LaplacianPattern(num_nodes, source, target, roots).factorize(weight)
        super().__init__(once._incidence, weight, once._solve)
