"""Factors that are made on one thread and let go of on another."""

from __future__ import annotations

import gc
import os
import subprocess
import sys
import threading
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, random_array

from rotavg_ros.solver.algebra.sparse import sparse_factor
from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor, order_of_little_fill, tied_matrix


def _matrix(size: int, density: float) -> csc_array:
    half = random_array((size, size), density=density, rng=np.random.default_rng(0))
    return csc_array(half + half.T + size * eye_array(size))


@pytest.mark.parametrize("is_ordered", [False, True])
def test_it_is_the_factor_of_the_matrix(is_ordered: bool) -> None:
    matrix = _matrix(60, 0.1)
    factor = SparseFactor(matrix, is_ordered=is_ordered)
    right = np.random.default_rng(1).standard_normal((60, 3))
    np.testing.assert_allclose(factor.solve(right), np.linalg.solve(matrix.toarray(), right), atol=1e-12)
    assert factor.log_det == pytest.approx(np.linalg.slogdet(matrix.toarray())[1], abs=1e-9)
    assert sorted(factor.rank) == list(range(60))
    if is_ordered:
        np.testing.assert_array_equal(factor.rank, np.arange(60))


def test_a_singular_matrix_is_refused() -> None:
    with pytest.raises(RuntimeError, match="singular"):
        SparseFactor(csc_array(np.zeros((3, 3))), is_ordered=True)
    assert SparseFactor(_matrix(5, 0.1), is_ordered=True).solve(np.ones(5)).shape == (5,)


def _on_a_thread(work: Callable[[], None]) -> None:
    thread = threading.Thread(target=work)
    thread.start()
    thread.join()


def _resident_mb() -> float:
    gc.collect()
    SparseFactor(_matrix(3, 0.5), is_ordered=True)  # what was let go of before has gone now
    line = next(line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmRSS"))
    return int(line.split()[1]) / 1024


@pytest.mark.parametrize("makes_here", [False, pytest.param(True, marks=pytest.mark.large)])
def test_whichever_thread_lets_go_of_it_its_memory_is_free_again(makes_here: bool) -> None:
    """SciPy's own would keep 20 MB of each."""
    matrix, held = _matrix(2000, 3e-3), []

    def make() -> None:
        held.append(SparseFactor(matrix, is_ordered=False))

    def turn() -> None:
        (make if makes_here else lambda: _on_a_thread(make))()
        (held.clear if not makes_here else lambda: _on_a_thread(held.clear))()

    turn()
    before = _resident_mb()
    for _ in range(6):
        turn()
    assert _resident_mb() - before < 30


def test_it_is_gone_when_nobody_holds_it() -> None:
    factor = SparseFactor(_matrix(5, 0.1), is_ordered=True)
    gone = weakref.ref(factor)
    del factor
    gc.collect()
    assert gone() is None


_SCRIPT = """
import os, threading
import numpy as np
from scipy.sparse import csc_array, eye_array
from rotavg_ros.solver.algebra.sparse.sparse_factor import SparseFactor, order_of_little_fill, tied_matrix

factor = SparseFactor(csc_array(2.0 * eye_array(5)), is_ordered=True)
child = os.fork()
if child == 0:
    threading.Timer(20.0, os._exit, (1,)).start()
    other = SparseFactor(csc_array(4.0 * eye_array(5)), is_ordered=True)
    assert factor.solve(np.ones(5)).sum() + other.solve(np.ones(5)).sum() == 3.75
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
assert factor.solve(np.ones(5)).sum() == 2.5
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
def test_forks_and_the_interpreters_end_leave_no_error_behind() -> None:
    """Factors that are alive then are there in both processes, and nothing is written."""
    ended = subprocess.run([sys.executable, "-c", _SCRIPT], capture_output=True, text=True, timeout=60, check=False)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")


def test_it_stays_what_it_was_when_the_matrix_gets_other_values() -> None:
    matrix = _matrix(5, 0.1)
    factor = SparseFactor(matrix, is_ordered=True)
    before = factor.solve(np.ones(5))
    matrix.data = 2 * matrix.data
    sparse_factor._let_all_go()  # where they are made, or SciPy leaves an error to the interpreter's end
    np.testing.assert_array_equal(factor.solve(np.ones(5)), before)


def test_an_order_of_little_fill_is_that_of_the_whole_factor() -> None:
    rng = np.random.default_rng(0)
    for size, far in ((1, 0), (2, 1), (50, 20), (400, 600)):
        chain = np.arange(size - 1)
        first, second = np.concatenate((np.stack((chain, chain + 1)), rng.integers(0, size, (2, far))), axis=1)
        whole = SparseFactor(tied_matrix(first, second, size), is_ordered=False)
        np.testing.assert_array_equal(order_of_little_fill(first, second, size), whole.rank)
