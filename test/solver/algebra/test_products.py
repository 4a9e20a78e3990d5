"""Products of large matrices against NumPy's, and on one thread."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest

from rotavg_ros.solver.algebra.products import inverse_of, inverse_of_positive, product


@pytest.mark.parametrize("shape", [(3, 4, 5), (0, 4, 2), (3, 0, 2), (300, 200, 1)])
def test_as_numpy_has_them(shape: tuple[int, int, int]) -> None:
    rng = np.random.default_rng(0)
    left, right = rng.normal(size=shape[:2]), rng.normal(size=shape[1:])
    np.testing.assert_allclose(product(left, right), left @ right, atol=1e-12)
    many = rng.normal(size=(7, *shape[:2]))
    np.testing.assert_allclose(product(many, right), many @ right, atol=1e-12)
    np.testing.assert_allclose(product(right.T, left.T), (left @ right).T, atol=1e-12)


def test_the_inverse_is_one() -> None:
    rows = np.random.default_rng(1).normal(size=(60, 40))
    matrix = rows.T @ rows
    np.testing.assert_allclose(inverse_of(matrix) @ matrix, np.eye(40), atol=1e-9)
    np.testing.assert_allclose(inverse_of_positive(matrix) @ matrix, np.eye(40), atol=1e-9)
    assert inverse_of_positive(np.empty((0, 0))).shape == (0, 0)
    indefinite = np.array([[1.0, 2.0], [2.0, 1.0]])  # as rounding may leave it
    np.testing.assert_allclose(inverse_of_positive(indefinite) @ indefinite, np.eye(2), atol=1e-12)


_BESIDES = """
import time
import numpy as np, torch
from rotavg_ros.solver.algebra.products import inverse_of, product
torch.set_num_threads(1)
matrix = np.random.default_rng(0).normal(size=(400, 400)) + 40 * np.eye(400)
product(matrix, inverse_of(matrix))
process, thread = time.process_time(), time.thread_time()
for _ in range(20):
    product(matrix, inverse_of(matrix))
process, thread = time.process_time() - process, time.thread_time() - thread
print(process / thread)
"""


def test_no_other_thread_has_to_do_with_them() -> None:
    """Of NumPy's own nearly half of the CPU time is spent on other threads, where there are several cores."""
    told = subprocess.run([sys.executable, "-c", _BESIDES], capture_output=True, text=True, check=True)
    assert float(told.stdout) < 1.2
