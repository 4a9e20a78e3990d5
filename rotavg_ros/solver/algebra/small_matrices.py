"""Many symmetric positive definite matrices of a few rows at once.

NumPy's own hand each matrix to LAPACK by itself, which costs microseconds; here each operation is one on all of them.
"""

from __future__ import annotations

import numpy as np


def inverse_root(matrices: np.ndarray) -> np.ndarray:
    """``(n, k, k)`` L⁻¹, lower triangular, of L Lᵀ = matrices ``(n, k, k)`` (Cholesky's L).

    Raises:
        numpy.linalg.LinAlgError: one of them is not positive definite.
    """
    size = matrices.shape[1]
    rest = np.ascontiguousarray(matrices.transpose(1, 2, 0))
    inverse = np.zeros_like(rest)
    inverse[np.arange(size), np.arange(size)] = 1.0
    for row in range(size):
        if not (rest[row, row] > 0).all():
            raise np.linalg.LinAlgError("a matrix is not positive definite")
        scale = 1 / np.sqrt(rest[row, row])
        # Elimination of a column takes the same multiples of its row from what has become of the identity.
        column = rest[row + 1 :, row] * scale
        inverse[row, : row + 1] *= scale
        for below in range(row + 1, size):
            inverse[below, : row + 1] -= column[below - row - 1] * inverse[row, : row + 1]
            rest[below, row + 1 :] -= column[below - row - 1] * column
    return np.ascontiguousarray(inverse.transpose(2, 0, 1))


def inverse(matrices: np.ndarray) -> np.ndarray:
    """``(n, k, k)`` inverses.

    Raises:
        numpy.linalg.LinAlgError: one of them is not positive definite.
    """
    root = inverse_root(matrices)
    return np.asarray(np.matmul(root.transpose(0, 2, 1), root))
