"""Least unsquared deviations (Wang & Singer 2013, "Exact and stable recovery of rotations for robust synchronization").

The Gram matrix ``G = R Rᵀ`` of stacked orientations (blocks ``G_vu = R_v R_uᵀ``) is relaxed to a semidefinite
programme,

    minimise Σ ‖R̃_uv − G_vu‖_F    subject to    G_vv = I,  G ⪰ 0,

that recovers noise-free inliers exactly among many outliers. The paper solves it by the alternating direction augmented
Lagrangian method on the dual, maximise ⟨Θ, R̃⟩ + tr Y with ‖Θ_vu‖ ≤ 1 on the edges, Y block diagonal, and
W = −(Θ + Y) ⪰ 0; G is the multiplier of that equation. With penalty μ, turn by turn,

    Y_v ← (I − G_vv)/μ − W_vv,    Θ_vu ← (R̃_uv − G_vu)/μ − W_vu, shortened to norm 1,    G ← μ [Θ + Y + G/μ]₊,

where [·]₊ keeps the positive part of the spectrum and W is what makes the equation hold. Orientations are the three
leading eigenvectors of G, block by block rounded to rotations.

Θ + Y is sparse and G of low rank, and W is needed on the edges only, so instead of a dense eigendecomposition per turn
the positive part comes from one block Krylov step from G's last range, with at most 30 eigenvectors: O(N + M) memory,
and the dense method's solution to within the stopping rule. Under noise G has more than three eigenvectors, and the
more the longer a graph is drawn out: the method is at its best on dense graphs and of little use on SLAM graphs.

Warm start: the G to start from. The programme is convex, so that it saves turns and hardly changes the answer.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse import bsr_array
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.blocks import BlockPattern, nearest_rotations
from rotavg_ros.baselines.start import solve_by_component, start_orientations, usable_edges
from rotavg_ros.view_graph import ViewGraph

_PENALTY = 2.0
_MAX_RANK = 30
_MAX_TURNS = 300
# The relative change of G on the pattern that ends the turns.
_CONVERGED_CHANGE = 3e-4
_SEED = 0


def wang(graph: ViewGraph, start: Tensor | None = None) -> Tensor:
    """Least-unsquared-deviations orientations, body_from_world ``(N, 4)`` float64.

    Noise-free graphs to rounding from a cold start.

    Args:
        start: body_from_world ``(N, 4)``; default: composed along a spanning tree.

    Raises:
        UserError: more blocks than fit into memory (see ``blocks.py``).
    """
    return solve_by_component(usable_edges(graph), start, _solve_connected)


def _solve_connected(graph: ViewGraph, start: Tensor | None) -> Tensor:
    pattern = BlockPattern.of(graph)
    known = pattern.known_blocks(graph)
    orientations, _ = start_orientations(graph, start)
    basis, eigenvalues = _gram(rotations.to_matrix(orientations).numpy().reshape(-1, 3))
    gram = pattern.product_blocks(basis * eigenvalues, basis)
    slack = np.zeros_like(gram)
    for _ in range(_MAX_TURNS):
        dual = (known - gram) / _PENALTY - slack
        length = np.linalg.norm(dual[: pattern.num_edges], axis=(1, 2), keepdims=True)
        dual[: pattern.num_edges] /= np.maximum(length, 1.0)
        basis, spectrum = _leading_eigenvectors(pattern.matrix(dual), basis, eigenvalues / _PENALTY)
        eigenvalues = _PENALTY * np.maximum(spectrum, 0.0)
        last_gram, gram = gram, pattern.product_blocks(basis * eigenvalues, basis)
        slack = (gram - last_gram) / _PENALTY - dual
        if np.linalg.norm(gram - last_gram) < _CONVERGED_CHANGE * np.linalg.norm(gram):
            break
    return nearest_rotations(basis[:, -3:].reshape(-1, 3, 3))


def _gram(stacked: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Orthonormal basis ``(3N, k)`` and eigenvalues ``(k,)``, ascending, of ``R Rᵀ``; k - 3 random ones have none."""
    size = len(stacked)
    rank = min(_MAX_RANK, size)
    random = np.random.default_rng(_SEED).standard_normal((size, rank - 3))
    basis, _ = np.linalg.qr(np.concatenate((stacked, random), axis=1))
    return basis[:, ::-1], np.concatenate((np.zeros(rank - 3), np.full(3, size / 3)))


def _leading_eigenvectors(
    sparse: bsr_array, basis: np.ndarray, eigenvalues: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Leading eigenvectors and -values, ascending, of ``sparse + basis diag(eigenvalues) basisᵀ``.

    Rayleigh–Ritz on the span of the basis and of its product with the matrix; exact once that span holds them.
    """

    def times(vectors: np.ndarray) -> np.ndarray:
        return np.asarray(sparse @ vectors + basis @ (eigenvalues[:, None] * (basis.T @ vectors)))

    krylov, _ = np.linalg.qr(np.concatenate((basis, times(basis)), axis=1))
    projected = krylov.T @ times(krylov)
    values, vectors = np.linalg.eigh((projected + projected.T) / 2)
    rank = basis.shape[1]
    return krylov @ vectors[:, -rank:], values[-rank:]
