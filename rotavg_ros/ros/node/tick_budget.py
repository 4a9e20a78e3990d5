"""A tick's budget, in seconds for people and in units of work for the solver."""

from __future__ import annotations

from collections import deque
from statistics import median

from rotavg_ros.solver import SECONDS_PER_UNIT

# Of so many ticks the median tells what a unit costs.
_TICKS = 20
# Ticks of fewer units say more of all else than of the solver.
_LEAST_WORK = 10.0


class TickBudget:
    """Learns from ticks what a unit of work costs on this machine, as busy as it is."""

    def __init__(self) -> None:
        self._seconds_per_unit: deque[float] = deque(maxlen=_TICKS)

    def units(self, seconds: float) -> float:
        """Units of work in so many seconds; before any tick has told, by what a unit costs elsewhere."""
        costs = median(self._seconds_per_unit) if self._seconds_per_unit else SECONDS_PER_UNIT
        return seconds / costs

    def learn(self, seconds: float, work: float) -> None:
        """So many units of work have taken so many seconds."""
        if work >= _LEAST_WORK:
            self._seconds_per_unit.append(seconds / work)
