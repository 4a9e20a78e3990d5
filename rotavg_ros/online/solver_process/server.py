"""The side that solves; :mod:`~rotavg_ros.online.solver_process.client` starts it."""

from __future__ import annotations

import os
import pickle
import queue
import threading
from multiprocessing.connection import Connection
from typing import Any

import torch

from rotavg_ros.errors import UserError
from rotavg_ros.online import free_memory
from rotavg_ros.online.solver_process.wire import ABANDON, KNOWN, Advance, Request, from_arrays, to_arrays
from rotavg_ros.solver import Abandoned, KeptLabels, abandonable, advance, solve
from rotavg_ros.view_graph import ViewGraph


class Server:
    """Solves what is asked for on a connection; the first message is the number of torch's threads."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection
        self._requests: queue.SimpleQueue[bytes] = queue.SimpleQueue()
        self._is_abandoned = False
        self._memory: tuple[int, object | None] = (0, None)
        self._routes: torch.Tensor | None = None
        self._after_work = free_memory.AfterWork()

    def run(self) -> None:
        """Solve until the other side has gone.

        Raises:
            EOFError: it has gone before it sent the number of threads.
        """
        torch.set_num_threads(int(self._connection.recv_bytes()))
        threading.Thread(target=self._listen, name="listener", daemon=True).start()
        while True:
            request: Request | Advance = pickle.loads(self._requests.get())  # noqa: S301 - of the process that started this one
            try:
                answer: object = self._solve(request) if isinstance(request, Request) else self._advance(request)
            except (UserError, Abandoned) as error:
                answer = error
            except Exception as error:
                answer = RuntimeError(f"{type(error).__name__}: {error}")
            try:
                self._connection.send_bytes(pickle.dumps(answer, protocol=5))
            except OSError:  # the other side has gone, and the listener has not noticed yet
                return

    def _listen(self) -> None:
        try:
            while True:
                message = self._connection.recv_bytes()
                if message == ABANDON:
                    self._is_abandoned = True
                else:
                    self._is_abandoned = False
                    self._requests.put(message)
        except (EOFError, OSError):
            os._exit(0)  # perhaps in the middle of a solve, which nobody waits for

    def _advance(self, request: Advance) -> float:
        number, memory = self._memory
        if number != request.remembered:
            return 0.0
        with abandonable(lambda: self._is_abandoned):
            spent = advance(memory, request.work)
        self._after_work.spent(spent)
        return spent

    def _solve(self, request: Request) -> dict[str, object]:
        with abandonable(lambda: self._is_abandoned):
            solution = solve(
                self._graph(request.graph),
                warm_start=None if request.warm_start is None else torch.from_numpy(request.warm_start),
                memory=self._memory_for(request),
                **request.options,
            )
        self._memory = request.number, solution.memory
        free_memory.give_back_after(len(solution.outlier_score), solution.stage_seconds)
        labels: KeptLabels | None = getattr(solution.memory, "labels", None)
        told = {"labels": None if labels is None else labels.arrays(), "remembers": solution.memory is not None}
        return to_arrays(solution) | {"memory": None} | told

    def _graph(self, told: dict[str, Any]) -> ViewGraph:
        graph = from_arrays(told)
        if isinstance(graph["routes"], torch.Tensor):
            self._routes = graph["routes"]
        elif graph["routes"] == KNOWN:
            graph["routes"] = self._routes
        return ViewGraph(**graph)

    def _memory_for(self, request: Request) -> object | None:
        number, memory = self._memory
        if request.labels is None:
            return memory if number == request.remembered else None
        arrays, graph = request.labels
        return KeptLabels.of_arrays(ViewGraph(**from_arrays(graph)), arrays)
