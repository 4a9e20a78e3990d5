"""Many symmetric matrices of a few rows at once.

NumPy passes each matrix to LAPACK separately, which costs microseconds. Here each operation acts on all matrices at
once, or is a compiled loop.
"""

from __future__ import annotations

import math

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# Largest number of Jacobi sweeps; after five or six, the entries beside the diagonal are negligible.
_ROUNDS = 20


def inverse_root(matrices: np.ndarray) -> np.ndarray:
    """L⁻¹ ``(n, k, k)``, lower triangular, of Cholesky's L Lᵀ of positive definite matrices ``(n, k, k)``.

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
        # Eliminating a column subtracts the same multiples of the row from the transformed identity.
        column = rest[row + 1 :, row] * scale
        inverse[row, : row + 1] *= scale
        for below in range(row + 1, size):
            inverse[below, : row + 1] -= column[below - row - 1] * inverse[row, : row + 1]
            rest[below, row + 1 :] -= column[below - row - 1] * column
    return np.ascontiguousarray(inverse.transpose(2, 0, 1))


def inverse(matrices: np.ndarray) -> np.ndarray:
    """Inverses ``(n, k, k)`` of positive definite matrices.

    Raises:
        numpy.linalg.LinAlgError: one of them is not positive definite.
    """
    root = inverse_root(matrices)
    return np.asarray(np.matmul(root.transpose(0, 2, 1), root))


def eigh(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Eigenvalues ``(n, k)`` in no order, and unit eigenvectors ``(n, k, k)`` in columns, by Jacobi rotations."""
    return _eigh(np.ascontiguousarray(matrices))


@compiled
def _eigh(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    count, size, _ = matrices.shape
    value, vector = np.empty((count, size)), np.zeros((count, size, size))
    left = np.empty((size, size))
    for n in range(count):
        own = vector[n]
        for i in range(size):
            own[i, i] = 1.0
            for j in range(size):
                left[i, j] = matrices[n, i, j]
        for _ in range(_ROUNDS):
            is_diagonal = True
            for p in range(size - 1):
                for q in range(p + 1, size):
                    beside = left[p, q]
                    if left[p, p] + abs(beside) == left[p, p] and left[q, q] + abs(beside) == left[q, q]:
                        continue
                    is_diagonal = False
                    ratio = (left[q, q] - left[p, p]) / (2 * beside)
                    tangent = (1.0 if ratio >= 0 else -1.0) / (abs(ratio) + math.sqrt(ratio * ratio + 1))
                    cosine = 1 / math.sqrt(tangent * tangent + 1)
                    sine = tangent * cosine
                    for i in range(size):
                        a, b = left[i, p], left[i, q]
                        left[i, p], left[i, q] = cosine * a - sine * b, sine * a + cosine * b
                    for i in range(size):
                        a, b = left[p, i], left[q, i]
                        left[p, i], left[q, i] = cosine * a - sine * b, sine * a + cosine * b
                        a, b = own[i, p], own[i, q]
                        own[i, p], own[i, q] = cosine * a - sine * b, sine * a + cosine * b
            if is_diagonal:
                break
        for i in range(size):
            value[n, i] = left[i, i]
    return value, vector
