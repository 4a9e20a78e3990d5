"""The answer to a case, and the time it takes."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Answer:
    """A solver's answer to a graph (N nodes, M edges).

    Attributes:
        body_from_world: ``(N, 4)`` float64 xyzw, every component in a gauge of its own.
        seconds, cpu_seconds: wall-clock and CPU time (of all threads) from the graph in memory to the answer.
        outlier_score: ``(M,)`` probability that the edge is an outlier; None: the solver does not judge edges.
        uncertainty: ``(N,)`` rad, stated standard deviation, NaN where unknown; None: it states none.
        position: ``(N, 3)`` metres in the world frame; None: only orientations.
    """

    body_from_world: Tensor
    seconds: float
    cpu_seconds: float
    outlier_score: Tensor | None = None
    uncertainty: Tensor | None = None
    position: Tensor | None = None


@dataclass
class Clock:
    """Wall-clock and CPU seconds of the blocks that ran under it."""

    seconds: float = 0.0
    cpu_seconds: float = 0.0

    @contextmanager
    def running(self) -> Iterator[None]:
        """Count what the block takes."""
        start, cpu_start = time.perf_counter(), time.process_time()
        yield
        self.seconds += time.perf_counter() - start
        self.cpu_seconds += time.process_time() - cpu_start
