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
        self._rest_s = self._rest_work = 0.0

    def units(self, seconds: float) -> float:
        """Units of work that fit into ``seconds``; before the first tick, by the default cost of a unit."""
        costs = median(self._seconds_per_unit) if self._seconds_per_unit else SECONDS_PER_UNIT
        return seconds / costs

    def learn(self, seconds: float, work: float) -> None:
        """Note that a tick of ``work`` units has taken ``seconds``."""
        if work >= _LEAST_WORK:
            self._seconds_per_unit.append(seconds / work)

    def learn_rest(self, seconds: float, work: float) -> None:
        """Note that ``work`` units of what a tick has left have taken ``seconds``.

        Nearly all of that is the solver's, so small pieces add up. After a slow tick (the first one loads, or compiles)
        all pieces are small: if they did not count, they would stay small for good.
        """
        if work > 0:
            self._rest_s, self._rest_work = self._rest_s + seconds, self._rest_work + work
        if self._rest_work >= _LEAST_WORK:
            self.learn(self._rest_s, self._rest_work)
            self._rest_s = self._rest_work = 0.0
