"""A tick's budget, in seconds for people and in units of work for the solver."""

from __future__ import annotations

from collections import deque
from statistics import median

# Of so many ticks the median tells what a unit costs; a unit costs about a millisecond before any has told.
_TICKS = 20
_SECONDS_PER_UNIT = 1e-3
# Ticks of fewer units say more of all else than of the solver.
_LEAST_WORK = 10.0


class TickBudget:
    """Learns from ticks what a unit of work costs on this machine, as busy as it is."""

    def __init__(self) -> None:
        self._seconds_per_unit: deque[float] = deque(maxlen=_TICKS)

    def units(self, seconds: float) -> float:
        """Of work in so many seconds."""
        costs = median(self._seconds_per_unit) if self._seconds_per_unit else _SECONDS_PER_UNIT
        return seconds / costs

    def learn(self, seconds: float, work: float) -> None:
        """What so many units have cost."""
        if work >= _LEAST_WORK:
            self._seconds_per_unit.append(seconds / work)
