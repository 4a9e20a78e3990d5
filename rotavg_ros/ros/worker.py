"""The one thread on which everything slow happens."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable
from typing import Any

from rclpy.executors import Executor
from rclpy.task import Future


class Worker:
    """Runs jobs one after the other; a service can await the future of one."""

    def __init__(self, executor: Executor) -> None:
        self._executor = executor
        self._stopping = False
        self._jobs: queue.SimpleQueue[tuple[Callable[[], Any], Future] | None] = queue.SimpleQueue()
        self._thread = threading.Thread(target=self._run, name="rotavg_worker", daemon=True)
        self._thread.start()

    def submit(self, job: Callable[[], Any]) -> Future:
        """Queue a job; its result or its exception goes to the future."""
        future = Future(executor=self._executor)
        self._jobs.put((job, future))
        return future

    def stop(self, timeout_s: float) -> bool:
        """Take no more jobs and wait for the running one; False if it was not done in time."""
        self._stopping = True
        self._jobs.put(None)
        self._thread.join(timeout_s)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (entry := self._jobs.get()) is not None:
            if self._stopping:
                break
            job, future = entry
            try:
                future.set_result(job())
            except Exception as error:
                future.set_exception(error)
