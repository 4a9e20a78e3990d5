"""A tick's budget, in seconds for people and in units of work for the solver."""

from __future__ import annotations

from collections import deque
from statistics import median

from rotavg_ros.solver import SECONDS_PER_UNIT

# Number of ticks over whose median the cost of a unit is taken.
_TICKS = 20
# Ticks of fewer units say more about everything else than about the solver.
_LEAST_WORK = 10.0


class TickBudget:
    """Learns from ticks what a unit of work costs on this machine under its present load."""

    def __init__(self) -> None:
        self._seconds_per_unit: deque[float] = deque(maxlen=_TICKS)

    def units(self, seconds: float) -> float:
        """Units of work that fit into ``seconds``; before the first tick, by the default cost of a unit."""
        costs = median(self._seconds_per_unit) if self._seconds_per_unit else SECONDS_PER_UNIT
        return seconds / costs

    def learn(self, seconds: float, work: float) -> None:
        """Note that ``work`` units have taken ``seconds``."""
        if work >= _LEAST_WORK:
            self._seconds_per_unit.append(seconds / work)
