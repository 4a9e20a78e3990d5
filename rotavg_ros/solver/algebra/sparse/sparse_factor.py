"""Sparse factors that any thread may release.

SciPy's SuperLU records the memory that it allocates in a dictionary of the current thread. It frees only what the
dictionary of the releasing thread has. A factor that is made on one thread and released on another is leaked. Here,
solves run on their own threads, and factors outlive them. So one thread, which lasts as long as the process, makes and
releases all factors. Any thread may solve with them.

If the interpreter ends a thread whose dictionary is not empty, at exit or in a forked process, SciPy leaves an error
set that nobody has raised. So all factors are released before either; one that is used again is made again.
"""

from __future__ import annotations

import atexit
import os
import threading
import weakref
from collections.abc import Callable
from concurrent.futures import Future
from copy import copy
from functools import partial
from queue import SimpleQueue

import numpy as np
from scipy.sparse import coo_array, csc_array
from scipy.sparse.linalg import SuperLU, spilu, splu

# Weight that ties each unknown to zero, where ties between unknowns weigh 1. It is enough for any order of elimination,
# and too little to make fill between distant unknowns vanish.
_SLIGHTLY = 1e-6


def tied_matrix(first: np.ndarray, second: np.ndarray, size: int) -> csc_array:
    """A positive definite matrix of the pattern whose fill does not vanish: a Laplacian plus a small diagonal.

    Args:
        first, second: ``(n,)`` pairs of tied unknowns, in any order, repeated or not.
        size: number of unknowns.
    """
    is_tie = first != second
    first, second = first[is_tie], second[is_tie]
    row, column = np.concatenate((first, second)), np.concatenate((second, first))
    degree = np.bincount(row, minlength=size)
    diagonal = np.arange(size)
    values = np.concatenate((np.full(len(row), -1.0), degree + _SLIGHTLY))
    ends = np.concatenate((row, diagonal)), np.concatenate((column, diagonal))
    return csc_array(coo_array((values, ends), shape=(size, size)))


def order_of_little_fill(first: np.ndarray, second: np.ndarray, size: int) -> np.ndarray:
    """Position ``(N,)`` of each unknown in a minimum-degree order of elimination, for ties as in :func:`tied_matrix`.

    SuperLU gives the order only with a factor. It chooses the order before it eliminates anything, so a factor that
    drops all fill has the same order, and takes a tenth of the time where there is much fill.
    """
    found: list[np.ndarray] = []
    _keeper.wait_for(partial(_put_in_order, found, tied_matrix(first, second, size)))
    return found[0]


def _put_in_order(found: list[np.ndarray], matrix: csc_array) -> None:
    factor = spilu(
        matrix,
        drop_tol=1.0,
        fill_factor=1.0,
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    found.append(factor.perm_c.astype(np.int64))


class SparseFactor:
    """L U of a symmetric positive definite matrix ``(N, N)``, pivots on the diagonal.

    Args:
        matrix: to be factorised.
        is_ordered: whether its rows and columns are in the order of elimination already.
        relax, panel: numbers of columns that SuperLU merges and processes at once. Supernodes of pose graphs are small:
            with 1 it takes three quarters of the time of its own defaults.

    Raises:
        RuntimeError: the matrix is exactly singular.
    """

    def __init__(self, matrix: csc_array, *, is_ordered: bool, relax: int = 1, panel: int = 1) -> None:
        # Nobody else may hold a reference to the factor: the keeper must be the last to release it.
        self._held: list[SuperLU] = []
        order = "NATURAL" if is_ordered else "MMD_AT_PLUS_A"
        # A shallow copy, since the caller may give its matrix another array of values.
        self._make = partial(_factorise, self._held, copy(matrix), order, (relax, panel))
        _keeper.wait_for(self._make)
        _live.add(self)
        weakref.finalize(self, _keeper.leave, self._held.clear).atexit = False

    @property
    def _factor(self) -> SuperLU:
        if not self._held:
            _keeper.wait_for(self._make)
        return self._held[0]

    def let_go(self) -> None:
        """Release the factor; to be called on the keeper's thread."""
        self._held.clear()

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """The solution of ``(N,)`` or ``(N, k)`` right-hand sides."""
        return np.asarray(self._factor.solve(right_hand_side))

    @property
    def rank(self) -> np.ndarray:
        """``(N,)`` position of each row in the order of elimination."""
        return np.asarray(self._factor.perm_c.astype(np.int64))

    @property
    def num_entries(self) -> int:
        """Number of entries of L and U together."""
        return int(self._factor.nnz)

    @property
    def log_det(self) -> float:
        """Log determinant of the matrix."""
        return float(np.log(np.abs(self._factor.U.diagonal())).sum())


_live: weakref.WeakSet[SparseFactor] = weakref.WeakSet()


def _factorise(held: list[SuperLU], matrix: csc_array, order: str, widths: tuple[int, int]) -> None:
    relax, panel = widths
    held.append(splu(matrix, order, 0.0, relax=relax, panel_size=panel, options={"SymmetricMode": True}))


def _let_all_go() -> None:
    """Release all factors, before a fork and at exit."""

    def let_go() -> None:
        for factor in list(_live):
            factor.let_go()

    if _keeper.has_begun:
        _keeper.wait_for(let_go)


class _Keeper:
    """A thread that executes tasks, one after another."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Start over; so in a forked process, which has none of its parent's threads."""
        self._lock = threading.Lock()
        # A simple queue, since finalizers put tasks into it at any moment.
        self._tasks: SimpleQueue[tuple[Callable[[], None], Future[None] | None]] = SimpleQueue()
        self._thread: threading.Thread | None = None

    @property
    def has_begun(self) -> bool:
        """Whether it has been given anything."""
        return self._thread is not None

    def wait_for(self, task: Callable[[], None]) -> None:
        """Execute a task and wait until it is done; what it raises is raised here."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="rotavg-factors", daemon=True)
                self._thread.start()
        done: Future[None] = Future()
        self._tasks.put((task, done))
        done.result()

    def leave(self, task: Callable[[], None]) -> None:
        """Execute a task later, without waiting."""
        self._tasks.put((task, None))

    def _run(self) -> None:
        while True:
            task, done = self._tasks.get()
            try:
                task()
            except BaseException as error:
                if done is not None:
                    done.set_exception(error)
            else:
                if done is not None:
                    done.set_result(None)
            del task, done


_keeper = _Keeper()
atexit.register(_let_all_go)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(before=_let_all_go, after_in_child=_keeper.begin)
