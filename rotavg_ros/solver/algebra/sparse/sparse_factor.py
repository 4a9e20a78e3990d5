"""Sparse factors that any thread may let go of.

SciPy's SuperLU lists the memory that it takes in a dictionary of the thread that runs, and frees only what the list of
the thread that lets go of it has. A factor that is made on one thread and let go of on another stays in the process for
good. Solves run on threads of their own here, and factors outlive them; so one thread, which lasts as long as the
process, makes them all and lets them all go. Any thread may solve with them.

Where the interpreter takes down a thread whose list is not empty, at exit and in a forked process, SciPy leaves an
error behind that nobody has raised. So before either all factors are let go of; one that is asked again is made again.
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

# What is tied to nothing by itself, beside ties of one: enough for any order of elimination, too little to let fill
# that lies far apart vanish.
_SLIGHTLY = 1e-6


def tied_matrix(first: np.ndarray, second: np.ndarray, size: int) -> csc_array:
    """A positive definite matrix of the pattern, of which no fill vanishes: a Laplacian and next to nothing.

    Args:
        first, second: ``(n,)`` unknowns that are tied, in any order and as often as it comes.
        size: unknowns.
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
    """``(N,)`` where each unknown stands in an order of elimination of minimum degree, for such ties.

    SuperLU tells it of a factor alone. It is chosen before anything is eliminated, so a factor that drops all fill has
    the same, and takes a tenth of the time where much fills in.
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
        is_ordered: whether its rows and columns are in the order in which they are to be eliminated.
        relax, panel: columns that SuperLU merges, and that it works on at once. Supernodes of pose graphs are small:
            with one it takes three quarters of the time that its own defaults take.

    Raises:
        RuntimeError: the matrix is exactly singular.
    """

    def __init__(self, matrix: csc_array, *, is_ordered: bool, relax: int = 1, panel: int = 1) -> None:
        # Nobody else may hold what is inside: the last to let go of it has to be the keeper.
        self._held: list[SuperLU] = []
        order = "NATURAL" if is_ordered else "MMD_AT_PLUS_A"
        # Whoever has the matrix may give it other values, in another array.
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
        """Of what is inside, on the thread of the keeper."""
        self._held.clear()

    def solve(self, right_hand_side: np.ndarray) -> np.ndarray:
        """The solution of ``(N,)`` or ``(N, k)`` right-hand sides."""
        return np.asarray(self._factor.solve(right_hand_side))

    @property
    def rank(self) -> np.ndarray:
        """``(N,)`` where each row stands in the order of elimination."""
        return np.asarray(self._factor.perm_c.astype(np.int64))

    @property
    def num_entries(self) -> int:
        """Of L and U together."""
        return int(self._factor.nnz)

    @property
    def log_det(self) -> float:
        """Of the matrix."""
        return float(np.log(np.abs(self._factor.U.diagonal())).sum())


_live: weakref.WeakSet[SparseFactor] = weakref.WeakSet()


def _factorise(held: list[SuperLU], matrix: csc_array, order: str, widths: tuple[int, int]) -> None:
    relax, panel = widths
    held.append(splu(matrix, order, 0.0, relax=relax, panel_size=panel, options={"SymmetricMode": True}))


def _let_all_go() -> None:
    """Before a fork, and at exit."""

    def let_go() -> None:
        for factor in list(_live):
            factor.let_go()

    if _keeper.has_begun:
        _keeper.wait_for(let_go)


class _Keeper:
    """A thread that does what it is given, one after another."""

    def __init__(self) -> None:
        self.begin()

    def begin(self) -> None:
        """Anew, as in a process that was forked, which has none of its parent's threads."""
        self._lock = threading.Lock()
        # Finalizers put into it, in the middle of anything.
        self._tasks: SimpleQueue[tuple[Callable[[], None], Future[None] | None]] = SimpleQueue()
        self._thread: threading.Thread | None = None

    @property
    def has_begun(self) -> bool:
        """Whether it has been given anything."""
        return self._thread is not None

    def wait_for(self, task: Callable[[], None]) -> None:
        """Until it is done; what it raises is raised here."""
        with self._lock:
            if self._thread is None:
                self._thread = threading.Thread(target=self._run, name="rotavg-factors", daemon=True)
                self._thread.start()
        done: Future[None] = Future()
        self._tasks.put((task, done))
        done.result()

    def leave(self, task: Callable[[], None]) -> None:
        """Have it done some time."""
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
