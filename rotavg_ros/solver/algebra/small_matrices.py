"""Many symmetric matrices of a few rows at once.

NumPy's own hand each matrix to LAPACK by itself, which costs microseconds; here each operation is one on all of them,
or a loop that is compiled.
"""

from __future__ import annotations

import math

import numpy as np

from rotavg_ros.solver.algebra.compiled import compiled

# Jacobi's turns leave next to nothing beside the diagonal after five rounds or six.
_ROUNDS = 20


def inverse_root(matrices: np.ndarray) -> np.ndarray:
    """``(n, k, k)`` L⁻¹, lower triangular, of L Lᵀ = positive definite matrices ``(n, k, k)`` (Cholesky's L).

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
    """``(n, k, k)`` inverses of positive definite matrices.

    Raises:
        numpy.linalg.LinAlgError: one of them is not positive definite.
    """
    root = inverse_root(matrices)
    return np.asarray(np.matmul(root.transpose(0, 2, 1), root))


@compiled
def eigh(matrices: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(n, k)`` eigenvalues in no order, and ``(n, k, k)`` unit eigenvectors in columns, by Jacobi's turns."""
    count, size, _ = matrices.shape
    value, vector = np.empty((count, size)), np.zeros((count, size, size))
    left = np.empty((size, size))
    for n in range(count):
        own = vector[n]
        left[:] = matrices[n]
        for i in range(size):
            own[i, i] = 1.0
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
