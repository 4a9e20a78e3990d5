"""A solve that can be suspended after some work and resumed later.

It runs on a thread of its own, which runs only while a caller waits in :meth:`Resumable.go_on`: the two threads take
turns and never run at once. So it runs the same code as a solve in one go, gives a bit-identical result, and can be
suspended at each factorisation.
"""

from __future__ import annotations

import threading
import traceback
import weakref
from collections.abc import Callable
from typing import Generic, TypeVar

import torch

from rotavg_ros.solver.running.threads import without_workers, workers
from rotavg_ros.solver.running.work import Abandoned, abandonable, abandonment, count, resting

Result = TypeVar("Result")

# Time limit for joining the thread, which is never reached, since the thread ends wherever it rests.
_PATIENCE_S = 5.0


class Resumable(Generic[Result]):
    """A suspended solve, not begun yet; it is abandoned when nobody holds a reference any more.

    Args:
        solve: the function to run.
    """

    def __init__(self, solve: Callable[[], Result]) -> None:
        self._turns = _Turns(solve)
        weakref.finalize(self, self._turns.give_up)

    @property
    def has_failed(self) -> bool:
        """Whether it has raised an exception, as when a tick is abandoned; it cannot be resumed."""
        return self._turns.error is not None

    @property
    def has_ended(self) -> bool:
        """Whether there is a result."""
        return self._turns.has_ended

    @property
    def spent(self) -> float:
        """Units of work spent so far."""
        return self._turns.spent

    @property
    def result(self) -> Result:
        """The result, once it :attr:`has_ended`."""
        (result,) = self._turns.results
        return result

    def go_on(self, units: float) -> bool:
        """Solve until ``units`` of work are spent; returns whether it has ended.

        A piece of work larger than the remaining units waits for the next call, unless this one has done nothing yet.

        Raises:
            Exception: whatever the solve raises, including :class:`~rotavg_ros.solver.running.work.Abandoned` if the
                solve around this call is abandoned.
        """
        turns = self._turns
        before = turns.spent
        try:
            turns.take(units)
        finally:
            count(turns.spent - before)
        if isinstance(turns.error, Abandoned):
            raise Abandoned
        if turns.error is not None:
            raise turns.error
        return turns.has_ended


class _Turns(Generic[Result]):
    """State shared by both threads."""

    def __init__(self, solve: Callable[[], Result]) -> None:
        self._solve = solve
        self._theirs, self._ours = threading.Semaphore(0), threading.Semaphore(0)
        self._begun = self._until = 0.0
        self._is_given_up = False
        self._is_abandoned: Callable[[], bool] = lambda: False
        self._thread: threading.Thread | None = None
        self.spent = 0.0
        self.has_ended = False
        self.results: list[Result] = []
        self.error: BaseException | None = None

    def take(self, units: float) -> None:
        """Let the other thread run, until it rests or ends."""
        if self.has_ended or self.error is not None:
            return
        self._begun, self._is_abandoned = self.spent, abandonment()
        self._until = self.spent + units
        if self._thread is None:
            self._thread = threading.Thread(target=self._run, name="rotavg-resumable", daemon=True)
            self._thread.start()
        self._theirs.release()
        try:
            self._ours.acquire()
        except BaseException as interrupt:  # Ctrl-C, while the other thread runs
            self.error, self._is_given_up = interrupt, True
            raise

    def give_up(self) -> None:
        """Makes the thread end, so that it is not cut off in the middle of work when the interpreter exits."""
        self._is_given_up = True
        self._theirs.release()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(_PATIENCE_S)

    def _run(self) -> None:
        self._theirs.acquire()
        try:
            with torch.no_grad(), workers(), abandonable(self._asks), resting(self._rest):
                self.results.append(self._solve())
            self.has_ended = True
        except BaseException as error:
            # Otherwise the error's frames would keep the solve's objects alive, and this object the error.
            traceback.clear_frames(error.__traceback__)
            self.error = self.error or (Abandoned() if isinstance(error, Abandoned) else error)
        del self._solve  # so that a reference to the result does not keep the solve's data alive
        self._ours.release()

    def _asks(self) -> bool:
        return self._is_given_up or self._is_abandoned()

    def _rest(self, units: float) -> None:
        is_too_much = self.spent > self._begun and self.spent + units > self._until
        if (is_too_much or self.spent >= self._until) and threading.current_thread() is self._thread:
            with without_workers():
                self._ours.release()
                self._theirs.acquire()
            if self._is_given_up:
                raise Abandoned
        self.spent += units
