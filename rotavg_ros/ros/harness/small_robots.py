"""The node on a small machine: memory and time for graphs of several sizes, on one core and on two."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Sequence

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.ros.harness import soak

CORES = (1, 2)
_RATE_HZ = 50.0


class TooFewCoresError(UserError):
    """The machine cannot show what more cores would do."""


def run(
    sizes: Sequence[int], seconds: float, watch: Callable[[Iterable[soak.Load]], Iterable[soak.Load]] = lambda it: it
) -> list[soak.SoakRow]:
    """A node for each size on one core and on two, odometry at 50 Hz.

    Args:
        sizes: numbers of keyframes, with as many loop closures.
        seconds: duration of each run, once the graph has been solved.
        watch: passes the runs through and may show their progress.

    Raises:
        TooFewCoresError: this process may use only one core.
        LiveRunError: see :func:`soak.run_loads`.
    """
    available = len(os.sched_getaffinity(0))
    if available < max(CORES):
        raise TooFewCoresError(f"this process may use {available} core; {max(CORES)} are needed to compare")
    loads = [soak.Load(size, seconds, _RATE_HZ, cores) for size in sizes for cores in CORES]
    return soak.run_loads(loads, watch)


def table(rows: Sequence[soak.SoakRow]) -> Table:
    """Memory and CPU by size and cores."""
    columns = (
        Column("keyframes"),
        Column("edges"),
        Column("cores"),
        Column("node, peak MB", ".0f"),
        Column("solver, peak MB", ".0f"),
        Column("both at the end MB", ".0f"),
        Column("cores busy", ".2f"),
        Column("first solve ms", ".0f"),
        Column("ticks"),
        Column("tick p50 ms", ".0f"),
        Column("tick p95 ms", ".0f"),
        Column("tick max ms", ".0f"),
        Column("callback p95 ms", ".2f"),
        Column("latency p95 ms", ".2f"),
        Column("lost"),
    )
    names = (
        *("keyframes", "edges", "cores", "node_mb", "solver_mb", "both_mb", "cpu_share", "start_max_ms", "ticks"),
        *("tick_p50_ms", "tick_p95_ms", "tick_max_ms", "callback_p95_ms", "latency_p95_ms", "lost"),
    )
    return Table(
        "Memory and time by size and cores", columns, tuple(tuple(getattr(row, name) for name in names) for row in rows)
    )
