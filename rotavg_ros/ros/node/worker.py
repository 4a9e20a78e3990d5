"""A thread for slow jobs."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from rclpy.executors import Executor
from rclpy.task import Future


@dataclass(frozen=True)
class Workers:
    """The node's two workers, so that a save need not wait for a solve."""

    solver: Worker
    saver: Worker


class Worker:
    """Runs jobs one after the other; a service can await the future of one."""

    def __init__(self, executor: Executor, name: str) -> None:
        self._executor = executor
        self._stopping = False
        self._waiting: set[Callable[[], Any]] = set()
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], Any]) -> Future:
        """Queue a job; its result or its exception goes to the future."""
        future = Future(executor=self._executor)
        self._jobs.put((job, future))
        return future

    def submit_once(self, job: Callable[[], Any]) -> None:
        """Queue a job unless it is already waiting, so that a timer cannot fill the queue."""
        if job not in self._waiting:
            self._waiting.add(job)
            self.submit(job)

    def stop(self, timeout_s: float, finish: bool = False) -> bool:
        """Take no more jobs and wait for the running one, or for all (``finish``); False if that took too long."""
        self._stopping = not finish
        self._jobs.put(None)
        self._thread.join(max(timeout_s, 0.0))
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            if self._stopping:
                break
            job, future = entry
            self._waiting.discard(job)  # before it runs: a change from now on requires another run
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
