"""R-GoDec: rotation averaging as a low-rank and sparse decomposition (Arrigoni, Rossi, Fragneto & Fusiello).

"Robust synchronization in SO(3) and SE(3) via low-rank and sparse matrix decomposition" (CVIU 2018) stacks the
relative rotations into a symmetric 3N × 3N matrix X of blocks ``R_v R_uᵀ``, which is ``R Rᵀ`` of rank three where it is
known, and splits it into

    X = L + S₁ + S₂ + noise,    rank L = 3,

with outliers S₁, whole blocks on the known pattern, penalised by λ times their summed Frobenius norms, and S₂ that
stands for the unknown blocks. Turn by turn, L is the rank-three approximation of X − S₁ − S₂, S₁ the block-wise soft
threshold of X − L on the pattern, and S₂ = −L off the pattern.

X − S₁ − S₂ is L plus a matrix on the pattern, and L is kept by its factors, so nothing here is dense: O(N + M) memory.
The rank-three step is GoDec's power scheme with L's last range in place of fresh random projections. Unknown blocks
fill in slowly; Nesterov's extrapolation between turns, restarted when the objective rises, leaves the fixed points as
they are and takes about a third of the turns. Graphs of large diameter (SLAM) still need more turns than there are.

The paper starts from L = X with zeros for unknown blocks, which on graphs of large diameter ends in wrong fixed points.
A cold start here is the ``R Rᵀ`` of orientations composed along a spanning tree, a warm start that of the given ones.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.sparse import bsr_array
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.blocks import BlockPattern, nearest_rotations
from rotavg_ros.baselines.start import solve_by_component, start_orientations, usable_edges
from rotavg_ros.view_graph import ViewGraph

_RANK = 3
# λ: the Frobenius norm beyond which a block's misfit counts as an outlier's; 2√2 sin(θ/2) with an angle θ of 1°.
_OUTLIER_NORM = 0.05
_MAX_TURNS = 1000
# The relative change of L on the pattern that ends the turns.
_CONVERGED_CHANGE = 1e-5


def arrigoni(graph: ViewGraph, start: Tensor | None = None) -> Tensor:
    """R-GoDec orientations, body_from_world ``(N, 4)`` float64.

    Noise-free graphs to rounding from a cold start.

    Args:
        start: body_from_world ``(N, 4)``; default: composed along a spanning tree.
    """
    return solve_by_component(usable_edges(graph), start, _solve_connected)


@dataclass(frozen=True)
class _LowRank:
    """``L = U C Uᵀ`` with orthonormal ``U`` ``(3N, 3)`` and its blocks on the pattern."""

    basis: np.ndarray
    core: np.ndarray
    blocks: np.ndarray

    @classmethod
    def of(cls, pattern: BlockPattern, basis: np.ndarray, core: np.ndarray) -> _LowRank:
        return cls(basis, core, pattern.product_blocks(basis @ core, basis))

    def times(self, vectors: np.ndarray) -> np.ndarray:
        return np.asarray(self.basis @ (self.core @ (self.basis.T @ vectors)))


def _solve_connected(graph: ViewGraph, start: Tensor | None) -> Tensor:
    pattern = BlockPattern.of(graph)
    known = pattern.known_blocks(graph)
    orientations, _ = start_orientations(graph, start)
    stacked = rotations.to_matrix(orientations).numpy().reshape(-1, _RANK)
    low_rank = _LowRank.of(pattern, stacked / np.sqrt(graph.num_nodes), graph.num_nodes * np.eye(_RANK))
    previous = low_rank
    objective, momentum_age = np.inf, 0
    for _ in range(_MAX_TURNS):
        momentum = momentum_age / (momentum_age + 3)
        extrapolated = low_rank.blocks + momentum * (low_rank.blocks - previous.blocks)
        # X − S₁ − L on the pattern: misfits, those of outliers cut down to λ.
        misfit = pattern.matrix(_clipped(known - extrapolated, pattern))
        following = _approximate(pattern, misfit, low_rank, previous, momentum)
        previous, low_rank = low_rank, following
        last_objective, objective = objective, _objective(known - low_rank.blocks, pattern)
        momentum_age = 0 if objective > last_objective else momentum_age + 1
        change = np.linalg.norm(low_rank.blocks - previous.blocks) / np.linalg.norm(low_rank.blocks)
        if change < _CONVERGED_CHANGE:
            break
    _, rotation = np.linalg.eigh(low_rank.core)
    return nearest_rotations((low_rank.basis @ rotation).reshape(-1, 3, 3))


def _approximate(
    pattern: BlockPattern, misfit: bsr_array, low_rank: _LowRank, previous: _LowRank, momentum: float
) -> _LowRank:
    """Rank-three approximation of the extrapolated L plus ``misfit``, by two power iterations from L's range."""

    def times(vectors: np.ndarray) -> np.ndarray:
        return np.asarray(
            misfit @ vectors + (1 + momentum) * low_rank.times(vectors) - momentum * previous.times(vectors)
        )

    basis, _ = np.linalg.qr(times(low_rank.basis))
    basis, _ = np.linalg.qr(times(basis))
    core = basis.T @ times(basis)
    return _LowRank.of(pattern, basis, (core + core.T) / 2)


def _clipped(misfit: np.ndarray, pattern: BlockPattern) -> np.ndarray:
    """The misfit less S₁, its soft threshold: blocks longer than λ become as long as λ. The diagonal has no S₁."""
    norm = np.linalg.norm(misfit, axis=(1, 2), keepdims=True)
    factor = np.minimum(1.0, _OUTLIER_NORM / np.maximum(norm, _OUTLIER_NORM))
    factor[pattern.num_edges :] = 1.0
    return np.asarray(misfit * factor)


def _objective(misfit: np.ndarray, pattern: BlockPattern) -> float:
    """What the turns bring down, ½ Σ ‖misfit − S₁‖² + λ ‖S₁‖ over both triangles: the Huber loss of the blocks."""
    norm = np.linalg.norm(misfit, axis=(1, 2))
    loss = np.where(norm < _OUTLIER_NORM, norm**2 / 2, _OUTLIER_NORM * (norm - _OUTLIER_NORM / 2))
    on_diagonal = np.arange(len(norm)) >= pattern.num_edges
    return float((pattern.share * np.where(on_diagonal, norm**2 / 4, loss)).sum())
