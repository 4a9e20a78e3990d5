"""Coarse parallelism: every worker processes its own part of an array, and each torch operation runs on one thread.

Torch can spread each operation over the cores by itself, but then every operation of some ten microseconds ends in a
barrier. On a machine that does anything else, each barrier waits for the scheduler: a solve of 0.3 s on an idle machine
took 4 s beside one busy process. Here threads meet once per layer.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import copy_context
from operator import itemgetter
from typing import TypeVar

import torch

from rotavg_ros.solver.running.work import stop_if_abandoned

Item = TypeVar("Item")

_STRETCHES_PER_WORKER = 4


class _Crew:
    """The workers of the solves that are running.

    Torch keeps two numbers of threads: each thread has its own, which its operations obey, and the process has one,
    which a thread copies when it first uses torch. Setting either sets both. So a thread that solves restores its own
    number when it leaves, and the last one to leave restores the process's number that the first one found.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._here = threading.local()
        self._active = 0
        self._pool: ThreadPoolExecutor | None = None
        self.size = 1

    def enter(self) -> None:
        self._here.depth = self._depth() + 1
        if self._here.depth > 1:
            return
        with self._lock:
            before = torch.get_num_threads()
            if self._active == 0:
                self.size = before
            elif before == 1:  # a thread that first uses torch while others solve has copied their number
                before = self.size
            self._here.before = before
            self._active += 1
            torch.set_num_threads(1)

    def leave(self) -> None:
        self._here.depth -= 1
        if self._here.depth > 0:  # the enclosing solve goes on with one thread for each operation
            return
        with self._lock:
            self._active -= 1
            torch.set_num_threads(self._here.before)
            if self._active > 0:
                return
            if self.size != self._here.before:  # restore the process's number, which this thread's has just replaced
                setter = threading.Thread(target=torch.set_num_threads, args=(self.size,))
                setter.start()
                setter.join()
            self.size = 1
            if self._pool is not None:
                self._pool.shutdown()
                self._pool = None

    def _depth(self) -> int:
        """How many times this thread has entered."""
        return getattr(self._here, "depth", 0)

    def pool(self) -> ThreadPoolExecutor:
        with self._lock:
            if self._pool is None:
                # A worker that first uses torch after another solve has ended would copy the process's number.
                self._pool = ThreadPoolExecutor(self.size, thread_name_prefix="rotavg", initializer=_keep_to_one_thread)
            return self._pool


def _keep_to_one_thread() -> None:
    """Set the calling thread's number; read it first, since torch's first use would copy the process's number."""
    torch.get_num_threads()
    torch.set_num_threads(1)


_crew = _Crew()


@contextmanager
def workers() -> Iterator[None]:
    """Inside, :func:`for_each` uses as many threads as torch was allowed, and torch's operations one each."""
    _crew.enter()
    try:
        yield
    finally:
        _crew.leave()


@contextmanager
def without_workers() -> Iterator[None]:
    """Inside, a solve that waits within :func:`workers` counts as having left it."""
    _crew.leave()
    try:
        yield
    finally:
        _crew.enter()


def num_workers() -> int:
    """Threads that :func:`for_each` uses now: 1 outside of :func:`workers`."""
    return _crew.size


def for_each(work: Callable[[Item], None], items: Sequence[Item], threads: int | None = None) -> None:
    """Call ``work`` for every item, on several threads; what one raises is raised here. Never nested.

    The calling thread works too, so it does not wait until another one is awake.

    Args:
        threads: largest number of threads; default: all workers.
    """
    threads = min(len(items), _crew.size if threads is None else min(threads, _crew.size))
    if threads <= 1:
        for item in items:
            stop_if_abandoned()
            work(item)
        return
    waiting = deque(enumerate(items))
    failures: list[tuple[int, BaseException]] = []

    def take_turns() -> None:
        while waiting:
            try:
                number, item = waiting.popleft()
            except IndexError:  # another thread has just taken the last one
                return
            try:
                stop_if_abandoned()
                work(item)
            except BaseException as error:  # raised below, in the calling thread
                failures.append((number, error))
                waiting.clear()

    in_context = torch.no_grad()(take_turns)  # gradients are switched off per thread, so in every worker
    pool, context = _crew.pool(), copy_context()
    helpers = [pool.submit(context.copy().run, in_context) for _ in range(threads - 1)]
    take_turns()
    for helper in helpers:
        if not helper.cancel():
            helper.result()
    if failures:
        try:
            raise min(failures, key=itemgetter(0))[1]
        finally:
            failures.clear()  # an error holds this frame, which would hold the error


def threads_on(device: torch.device) -> int | None:
    """Threads for :func:`for_each`: all workers on a CPU; one for an accelerator, since one keeps its queue full."""
    return None if device.type == "cpu" else 1


def slices(length: int, size: int, device: torch.device) -> list[slice]:
    """Slices that cover ``range(length)``: of ``size`` on a CPU, for its caches, and one slice on an accelerator."""
    size = size if device.type == "cpu" else max(length, 1)
    return [slice(start, min(start + size, length)) for start in range(0, length, size)]


def stretches(items: Sequence[Item]) -> list[Sequence[Item]]:
    """The items in a few runs per worker: enough that a delayed worker does not delay all."""
    length = max(1, -(-len(items) // (_STRETCHES_PER_WORKER * num_workers())))
    return [items[start : start + length] for start in range(0, len(items), length)]
