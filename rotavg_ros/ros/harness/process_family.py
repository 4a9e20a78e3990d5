"""CPU time and memory of a process and its children: a node solves in a process of its own."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path

_PROC = Path("/proc")


def children(pid: int) -> list[int]:
    """Ids of the child processes that still run, ascending."""
    return [other for other in sorted(_pids()) if _parent(other) == pid]


def cpu_seconds(pid: int) -> float:
    """User and system time so far of all threads of the process and its children."""
    ticks = 0
    for each in (pid, *children(pid)):
        fields = _fields(each)
        ticks += int(fields[11]) + int(fields[12]) if fields else 0
    return ticks / os.sysconf("SC_CLK_TCK")


def peak_memory_mb(pid: int) -> float:
    """Peak resident memory of the process, 10⁶ bytes; 0 if it has ended."""
    try:
        status = (_PROC / str(pid) / "status").read_text(encoding="utf-8")
    except OSError:
        return 0.0
    kilobytes = next((line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:")), "0")
    return 1024e-6 * int(kilobytes)


def memory_mb(pid: int) -> float:
    """Resident memory of the process and its children, 10⁶ bytes; shared memory counts once."""
    return sum(map(_proportional_mb, (pid, *children(pid))))


def _proportional_mb(pid: int) -> float:
    """Resident memory, 10⁶ bytes, with 1/n of what n processes share; 0 if the process has ended."""
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
    """Fields of /proc/PID/stat, from the state on; empty if the process has ended."""
    try:
        return (_PROC / str(pid) / "stat").read_text(encoding="utf-8").rpartition(")")[2].split()
    except OSError:
        return []
