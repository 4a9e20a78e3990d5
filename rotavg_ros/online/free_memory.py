"""Returns the memory that a solve took to the system, where a robot's other programs can use it."""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Iterable
from functools import cache

# Whole solves of at least this many edges take enough memory to justify the milliseconds of giving it back.
_MANY_EDGES = 1000
_STAGES_OF_UPDATES = {"update", "poses"}
# The work after answers takes as much memory in this many units of work, 1.5 s.
_MUCH_WORK = 3000.0


def give_back_after(num_edges: int, stages: Iterable[str]) -> None:
    """Return memory after a whole solve of a large graph, given the stages that ran."""
    if num_edges >= _MANY_EDGES and not set(stages) <= _STAGES_OF_UPDATES:
        give_back()


class AfterWork:
    """Returns memory now and then, while work goes on in parts."""

    def __init__(self) -> None:
        self._units = 0.0

    def spent(self, units: float) -> None:
        """Note the units of work that were done."""
        self._units += units
        if self._units >= _MUCH_WORK:
            self._units = 0.0
            give_back()


def give_back() -> None:
    """Return the memory that is free in this process, as far as the C library can (glibc); costs milliseconds.

    What a solve keeps lies above its temporary memory, which would otherwise stay in the process.
    """
    trim = _malloc_trim()
    if trim is not None:
        trim(0)


@cache
def _malloc_trim() -> Callable[[int], int] | None:
    try:
        trim = ctypes.CDLL(None).malloc_trim
    except (AttributeError, OSError, TypeError):  # another C library, or no way to ask for it
        return None
    trim.argtypes, trim.restype = [ctypes.c_size_t], ctypes.c_int
    return trim
