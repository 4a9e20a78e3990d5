"""Products and inverses of large dense matrices, on the calling thread.

NumPy calls OpenBLAS, which spreads the work over the cores and busy-waits: next to other processes, each call takes
time slices of some milliseconds. Torch obeys its number of threads, which is one within a solve.
"""

from __future__ import annotations

import numpy as np
import torch


def product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``left @ right``, of two matrices or of stacks of matrices."""
    return np.asarray(torch.matmul(torch.from_numpy(left), torch.from_numpy(right)).numpy())


def inverse_of(matrix: np.ndarray) -> np.ndarray:
    """Inverse of ``(n, n)``.

    Raises:
        torch.linalg.LinAlgError: it has none.
    """
    return np.asarray(torch.linalg.inv(torch.from_numpy(matrix)).numpy())


def inverse_of_positive(matrix: np.ndarray) -> np.ndarray:
    """Inverse of a positive definite ``(n, n)``, by its lower triangle.

    A matrix that rounding has made indefinite is inverted as any other one.

    Raises:
        torch.linalg.LinAlgError: it has none.
    """
    lower, info = torch.linalg.cholesky_ex(torch.from_numpy(matrix))
    if int(info):
        return inverse_of(matrix)
    return np.asarray(torch.cholesky_inverse(lower).numpy())
