"""What a process and those that it has started take: a node solves in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

_PROC = Path("/proc")


def children(pid: int) -> list[int]:
    """Processes that this one has started and that still run, in the order of their numbers."""
    return [other for other in sorted(_pids()) if _parent(other) == pid]


def cpu_seconds(pid: int) -> float:
    """User and system time so far, of all threads, of the process and its children."""
    ticks = 0
    for each in (pid, *children(pid)):
        fields = _fields(each)
        ticks += int(fields[11]) + int(fields[12]) if fields else 0
    return ticks / os.sysconf("SC_CLK_TCK")


def peak_memory_mb(pid: int) -> float:
    """The most memory that the process has had resident, 10⁶ bytes; 0 if it has ended."""
    try:
        status = (_PROC / str(pid) / "status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    kilobytes = next((line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")), "0")
    return 1024e-6 * int(kilobytes)


def memory_mb(pid: int) -> float:
    """What the process and its children have resident, 10⁶ bytes; what several share counts once."""
    return sum(map(_proportional_mb, (pid, *children(pid))))


def _proportional_mb(pid: int) -> float:
    """Resident, 10⁶ bytes, of which what n processes share counts for an n-th part; 0 if it has ended."""
    try:
        rolled_up = (_PROC / str(pid) / "smaps_rollup").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    return 1024e-6 * int(next(line.split()[1] for line in rolled_up.splitlines() if line.startswith("Pss:")))


def _pids() -> Iterator[int]:
    return (int(folder.name) for folder in _PROC.iterdir() if folder.name.isdigit())


def _parent(pid: int) -> int:
    fields = _fields(pid)
    return int(fields[1]) if fields else -1


def _fields(pid: int) -> list[str]:
    """Of /proc/PID/stat, from the state on; empty if the process has ended."""
    try:
        return (_PROC / str(pid) / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return []
