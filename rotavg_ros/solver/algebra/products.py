"""Products and inverses of large dense matrices, on the thread that asks for them.

NumPy's go to OpenBLAS, which spreads them over the cores and waits busily: beside other work each takes time slices of
some milliseconds. Torch's obey its number of threads, which is one within a solve.
"""

from __future__ import annotations

import numpy as np
import torch


def product(left: np.ndarray, right: np.ndarray) -> np.ndarray:
    """``left @ right``, of matrices or of many of them."""
    return np.asarray(torch.matmul(torch.from_numpy(left), torch.from_numpy(right)).numpy())


def inverse_of(matrix: np.ndarray) -> np.ndarray:
    """Of ``(n, n)``.

    Raises:
        torch.linalg.LinAlgError: it has none.
    """
    return np.asarray(torch.linalg.inv(torch.from_numpy(matrix)).numpy())


def inverse_of_positive(matrix: np.ndarray) -> np.ndarray:
    """Of a positive definite ``(n, n)``, of which the lower triangle is read, or what rounding has left of one.

    Raises:
        torch.linalg.LinAlgError: it has none.
    """
    lower, info = torch.linalg.cholesky_ex(torch.from_numpy(matrix))
    if int(info):
        return inverse_of(matrix)
    return np.asarray(torch.cholesky_inverse(lower).numpy())
