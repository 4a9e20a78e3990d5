"""The side that asks: :func:`rotavg_ros.solve` in another process."""

from __future__ import annotations

import atexit
import pickle
import threading
from contextlib import suppress
from dataclasses import dataclass, replace
from typing import Any

from torch import Tensor

from rotavg_ros.errors import UserError
from rotavg_ros.online.solver_process.process import ServerProcess, Spawned
from rotavg_ros.online.solver_process.wire import ABANDON, KNOWN, Advance, Request, from_arrays, to_arrays
from rotavg_ros.solver import Abandoned, KeptLabels, Solution, stop_if_abandoned
from rotavg_ros.view_graph import ViewGraph

# Interval, in seconds, of checks whether the solve that is under way is still wanted.
_PATIENCE_S = 0.02
_EXIT_TIMEOUT_S = 5.0
# A process that was told to give up is ended if nothing has come from it for this long, in seconds. Between two of its
# looks at whether it is wanted lies a factorisation (seconds at 100 000 keyframes), or the compilation of a function.
_LAST_WORD_S = 60.0


@dataclass(frozen=True)
class _Remembered:
    """Stands for what the other process remembers of its last solve.

    Attributes:
        number: of the solve.
        labels: all that is left of it once the process has died, or remembers another solve.
    """

    number: int
    labels: KeptLabels | None


class SolverProcess:
    """Callable as :func:`rotavg_ros.solve`; one solve at a time.

    Python runs one thread at a time, so a solve of small steps in the same process delays each odometry message by
    milliseconds, and by a hundred on a busy machine. Here only arrays come and go. What a solve remembers for the next
    one stays in the other process, except for the labels. If that process dies, the solve fails, and the next one
    starts another process, which continues from the labels. So does a solve after one that was abandoned just as it
    ended, which has taken the place of what was remembered before.
    """

    def __init__(self, threads: int, process: ServerProcess | None = None) -> None:
        """Begin with a process that takes a second or two to be ready; the first solve waits for it.

        Args:
            threads: number of torch's threads.
            process: the process that solves; default: another interpreter.
        """
        self._threads = threads
        self._lock = threading.Lock()
        self._solves = 0
        self._held = 0  # number of the solve whose memory the process has
        self._routes: Tensor | None = None
        self._is_over = False
        self._begin(process or _spawned())
        atexit.register(self.close)

    def _begin(self, process: ServerProcess) -> None:
        self._process = process
        with suppress(OSError):  # it has died, which the first solve reports
            process.connection.send_bytes(str(self._threads).encode())

    @property
    def is_alive(self) -> bool:
        """Whether the process is running, as far as this side knows; only meaningful between solves."""
        connection = self._process.connection
        # Nothing was asked, so anything readable is the end of the stream.
        return not connection.closed and not connection.poll(0)

    @property
    def pid(self) -> int:
        return self._process.pid

    def __call__(
        self,
        graph: ViewGraph,
        *,
        warm_start: Tensor | None = None,
        memory: object | None = None,
        **options: Any,
    ) -> Solution:
        """See :func:`rotavg_ros.solve`.

        Raises:
            UserError: as there; or the process has died or hangs, or no other can be started in its place.
            Abandoned: the solution is no longer wanted.
        """
        with self._lock:
            if not self.is_alive:
                self._begin_again()
            self._solves += 1
            request = Request(self._solves, self._told(graph), None, None, options)
            if isinstance(memory, _Remembered) and memory.number == self._held:
                request.remembered = memory.number
            elif isinstance(memory, _Remembered | KeptLabels) and (kept := memory.labels) is not None:
                request.labels = kept.arrays(), to_arrays(kept.graph)
            if warm_start is not None:
                request.warm_start = warm_start.numpy()
            outcome: dict[str, Any] = self._outcome(request)
            remembers, labels = (outcome.pop(name) for name in ("remembers", "labels"))
            solution = Solution(**from_arrays(outcome))
            if not remembers:
                return solution
            kept = None
            if labels is not None:
                with suppress(ValueError):  # the answer is as good without them
                    kept = KeptLabels.of_arrays(graph, labels)
            return replace(solution, memory=_Remembered(request.number, kept))

    def _begin_again(self) -> None:
        """Replace a process that has ended; where that fails, the next solve tries it again."""
        if self._is_over:
            raise UserError("the solver's process was closed")
        self._process.close()
        self._begin(_spawned())
        self._held, self._routes = 0, None

    def _told(self, graph: ViewGraph) -> dict[str, Any]:
        """A graph's fields; routes, which only change with a thinning, are sent once."""
        fields = to_arrays(graph)
        if graph.routes is not None:
            before, self._routes = self._routes, graph.routes  # kept, so that no other tensor takes its address
            if before is not None and before.data_ptr() == graph.routes.data_ptr() and len(before) == len(graph.routes):
                fields["routes"] = KNOWN
        return fields

    def advance(self, memory: object | None, work: float) -> float:
        """See :func:`rotavg_ros.solver.advance`.

        Raises:
            UserError: the process has died or hangs.
            Abandoned: the work is no longer wanted.
        """
        if not isinstance(memory, _Remembered):
            return 0.0
        with self._lock:
            return float(self._outcome(Advance(memory.number, work))) if self.is_alive else 0.0

    def _outcome(self, request: Request | Advance) -> Any:
        try:
            return self._answer(request)
        except (EOFError, OSError) as error:
            how = self._process.exit_code(_EXIT_TIMEOUT_S)
            raise UserError(
                f"the solver's process has died (exit code {how}; -9 is what a lack of memory looks like); it is "
                "started again"
            ) from error

    def _answer(self, request: Request | Advance) -> Any:
        self._process.connection.send_bytes(pickle.dumps(request, protocol=5))
        while not self._process.connection.poll(_PATIENCE_S):
            try:
                stop_if_abandoned()
            except Abandoned:
                self._abandon(request)
                raise
        outcome = self._received(request)
        if isinstance(outcome, BaseException):
            raise outcome
        return outcome

    def _abandon(self, request: Request | Advance) -> None:
        """Let the process give up, and drop its last word, which may be the answer.

        Raises:
            UserError: it hangs, and was ended.
        """
        connection = self._process.connection
        connection.send_bytes(ABANDON)
        if not connection.poll(_LAST_WORD_S):
            self._process.close()
            raise UserError(
                f"the solver's process has hung: nothing came for {_LAST_WORD_S:.0f} s after it was told to give up; "
                "it is started again"
            )
        self._received(request)

    def _received(self, request: Request | Advance) -> Any:
        """What the process sends: the outcome, or the exception in which the work ended."""
        outcome = pickle.loads(self._process.connection.recv_bytes())  # noqa: S301 - of our own process
        if isinstance(request, Request) and not isinstance(outcome, BaseException):
            self._held = request.number
        return outcome

    def close(self) -> None:
        """End the process for good, even in the middle of a solve."""
        self._is_over = True
        self._process.close()


def _spawned() -> ServerProcess:
    try:
        return Spawned()
    except OSError as error:  # no memory, most often: what ended the process before
        raise UserError(
            f"the solver's process cannot be started ({error.strerror}); the next solve tries it again"
        ) from error
