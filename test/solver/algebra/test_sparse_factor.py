"""Factors that are made on one thread and let go of on another."""

from __future__ import annotations

import gc
import os
import threading
import weakref
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from scipy.sparse import csc_array, eye_array, random_array

from rotavg_ros.solver.algebra.sparse_factor import SparseFactor


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


@pytest.mark.parametrize("makes_here", [False, True])
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


@pytest.mark.skipif(not hasattr(os, "fork"), reason="no fork on this system")
@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_forked_process_has_a_keeper_of_its_own() -> None:
    SparseFactor(_matrix(5, 0.1), is_ordered=True)
    child = os.fork()
    if child == 0:
        threading.Timer(20.0, os._exit, (1,)).start()
        SparseFactor(_matrix(5, 0.1), is_ordered=True)
        os._exit(0)
    assert os.waitpid(child, 0)[1] == 0
