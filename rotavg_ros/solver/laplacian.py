"""Weighted graph Laplacians: one sparse factorisation, many right-hand sides.

Residuals are rotations of the world frame, so the three components of a correction share one scalar Laplacian
``L = Bᵀ W B``, grounded at the roots (one per connected component).
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from functools import partial

import numpy as np
from scipy.linalg import cho_factor, cho_solve
from scipy.sparse import coo_array
from scipy.sparse.linalg import splu

# How much stiffer than its own edges a root is tied to zero.
_GROUNDING = 1e6
# A graph with more than this share of all pairs fills in completely, and dense Cholesky is then many times faster.
_DENSE_SHARE = 0.01
_DENSE_MAX_NODES = 5000


class LaplacianSystem:
    """``L`` of a weighted graph, factorised.

    Args:
        num_nodes: N.
        source, target: ``(E,)`` ends of the edges.
        weight: ``(E,)`` positive weights; a node reached by tiny weights alone stays solvable.
        roots: one node of each connected component; their solution is zero.
    """

    def __init__(
        self, num_nodes: int, source: np.ndarray, target: np.ndarray, weight: np.ndarray, roots: np.ndarray
    ) -> None:
        self.num_nodes = num_nodes
        self.source, self.target, self.weight = source, target, weight
        degree = np.bincount(source, weight, num_nodes) + np.bincount(target, weight, num_nodes)
        degree = degree.astype(np.float64)  # bincount counts in integers where there is no edge
        degree[roots] += _GROUNDING * max(float(weight.max(initial=0.0)), 1.0)
        diagonal = np.arange(num_nodes)
        matrix = coo_array(
            (
                np.concatenate((-weight, -weight, degree)),
                (np.concatenate((source, target, diagonal)), np.concatenate((target, source, diagonal))),
            ),
            shape=(num_nodes, num_nodes),
        )
        fills_in = len(source) > _DENSE_SHARE * num_nodes**2 / 2
        self._solve = _factorize(matrix, dense=fills_in and num_nodes <= _DENSE_MAX_NODES)

    def incidence_sum(self, edge_values: np.ndarray) -> np.ndarray:
        """``Bᵀ x``: at every node the values ``(E, k)`` of edges that end there, less those that start there."""
        columns = [
            np.bincount(self.target, column, self.num_nodes) - np.bincount(self.source, column, self.num_nodes)
            for column in edge_values.T
        ]
        return np.stack(columns, axis=1)

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """``L⁻¹ b`` for ``(N, k)`` columns."""
        return np.asarray(self._solve(right_hand_side))

    def fit(self, difference: np.ndarray) -> np.ndarray:
        """Node values ``(N, k)`` whose differences target − source fit ``difference`` ``(E, k)`` best."""
        return self.solve(self.incidence_sum(self.weight[:, None] * difference))

    def samples(self, signs: np.ndarray) -> np.ndarray:
        """Node values ``(N, k)`` whose second moments are ``L⁻¹``, from independent signs ±1 ``(E, k)``.

        Spielman & Srivastava (2008): mean squared differences of such samples estimate effective resistances, that is
        variances of estimated differences, with a relative error of √(2/k).
        """
        return self.solve(self.incidence_sum(np.sqrt(self.weight)[:, None] * signs))


def _factorize(matrix: coo_array, dense: bool) -> Callable[[np.ndarray], np.ndarray]:
    """What solves for right-hand sides."""
    if dense:
        # Weights that span all of double precision can leave no positive pivot; the sparse factorisation copes.
        with suppress(np.linalg.LinAlgError):
            return partial(cho_solve, cho_factor(matrix.toarray(), lower=True, overwrite_a=True))
    factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return factor.solve  # type: ignore[no-any-return]


def probe_signs(first: np.ndarray, second: np.ndarray, num_probes: int) -> np.ndarray:
    """Signs ±1 ``(E, num_probes)`` that depend on an edge's two node numbers alone; reversing it negates them.

    Hashed (SplitMix64), not drawn: the order of the edges and edges that are added later change nothing. Parallel edges
    share their signs; their number among the parallels is mixed in to keep them independent.
    """
    low, high = np.minimum(first, second).astype(np.uint64), np.maximum(first, second).astype(np.uint64)
    order = np.lexsort((high, low))
    same = np.zeros(len(low), dtype=np.int64)
    repeated = (np.diff(low[order]) == 0) & (np.diff(high[order]) == 0)
    run = np.arange(1, len(low))
    start = np.maximum.accumulate(np.where(repeated, 0, run)) if len(low) > 1 else run
    same[order[1:]] = np.where(repeated, run - start, 0)
    key = _mix(low * np.uint64(0x9E3779B97F4A7C15) ^ _mix(high ^ _mix(same.astype(np.uint64))))
    words = -(-num_probes // 64)
    bits = [_mix(key + np.uint64(word + 1)) for word in range(words)]
    shifts = np.arange(64, dtype=np.uint64)
    signs = np.concatenate([((word[:, None] >> shifts) & np.uint64(1)).astype(np.float64) for word in bits], axis=1)
    return (2 * signs[:, :num_probes] - 1) * np.where(first < second, 1.0, -1.0)[:, None]


def _mix(value: np.ndarray) -> np.ndarray:
    """The finaliser of SplitMix64 (Steele et al. 2014); unsigned arithmetic wraps around."""
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return np.asarray(value ^ (value >> np.uint64(31)))
