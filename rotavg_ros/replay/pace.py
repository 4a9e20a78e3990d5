"""When a replay ticks: as often as the node while the graph is small, and less often where ticks are expensive.

A tick's cost is counted in units of work, never in seconds, so that a bag leads to the same ticks on every machine. The
last answer is a cold solve of everything, so it does not depend on the pace.
"""

from __future__ import annotations

from dataclasses import dataclass

from rotavg_ros.solver import SECONDS_PER_UNIT
from rotavg_ros.stamps import NANOSECONDS


@dataclass(frozen=True)
class WorkRates:
    """What a tick costs, and what a replay may spend, in the solver's units of work.

    A unit is :data:`~rotavg_ros.solver.SECONDS_PER_UNIT` of CPU.

    Attributes:
        bare: additional units that a tick costs for each keyframe and edge of the graph.
        at_first: units that may be spent from the start, so that a bag of some thousand keyframes never waits.
        per_second: further units that may be spent for each second of the bag's time.
    """

    bare: float = 0.0015
    at_first: float = 2400.0
    per_second: float = 8.0


class Pace:
    """Decides at which strikes of the replay's clock there is a tick."""

    def __init__(self, period_s: float, rates: WorkRates | None) -> None:
        """Begin with the first message.

        Args:
            period_s: time between strikes, in the bag's time.
            rates: None: every strike is a tick.
        """
        self.period_ns = round(period_s * NANOSECONDS)
        self._rates = rates
        self._saved = 0.0 if rates is None else rates.at_first

    def strikes(self, count: int = 1) -> bool:
        """``count`` periods have passed; returns whether there may be a tick now."""
        if self._rates is not None:
            self._saved += count * self._rates.per_second * self.period_ns / NANOSECONDS
        return self._saved >= 0

    def spend(self, size: int, work: float) -> None:
        """A tick has given an answer.

        Args:
            size: number of keyframes and edges of the graph.
            work: units that the solver has spent on it.
        """
        if self._rates is not None:
            self._saved -= size * self._rates.bare + work

    def told(self) -> str:
        """A line for the user about the pace, shown before the replay."""
        every = f"a tick every {self.period_ns / NANOSECONDS:g} s of the bag's time"
        if self._rates is None:
            return every
        return (
            f"{every}, less often where ticks are dear: {self._rates.per_second:g} units of work a second, about "
            f"{1e3 * SECONDS_PER_UNIT:g} ms each; -p solve_period_s:=S sets it"
        )
