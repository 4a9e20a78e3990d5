"""When a replay ticks: as often as the node does while its graph is small, and less often where a tick is dear.

A tick's cost is counted in units of work, never in seconds, so that a bag leads to the same ticks on every machine. On
the last answer, which is a cold solve of everything, it has no influence.
"""

from __future__ import annotations

from dataclasses import dataclass

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class WorkRates:
    """What a tick costs, and what a replay may spend, in units of work.

    A unit is what a tick in which odometry alone came costs for each keyframe and edge of the graph: 1.6 µs of CPU time
    on B25b. One that has to judge closures costs 7 times as much there (median).

    Attributes:
        with_closures: units for each keyframe and edge where closures are new.
        at_first: that may be spent at any time: a bag of some thousand keyframes never waits.
        per_second: that may be spent besides, for each second of the bag's time.
    """

    with_closures: int = 7
    at_first: int = 1_500_000
    per_second: int = 5_000


class Pace:
    """The strikes of the replay's clock, and which of them are ticks."""

    def __init__(self, period_s: float, rates: WorkRates | None) -> None:
        """Begin with the first message.

        Args:
            period_s: between strikes, of the bag's time.
            rates: None: every strike is a tick.
        """
        self.period_ns = round(period_s * NANOSECONDS)
        self._rates = rates
        self._saved = 0.0 if rates is None else float(rates.at_first)
        self._closures = 0

    def strikes(self, count: int = 1) -> bool:
        """So many periods have passed: whether there may be a tick now."""
        if self._rates is not None:
            self._saved += count * self._rates.per_second * self.period_ns / NANOSECONDS
        return self._saved >= 0

    def spend(self, size: int, closures: int) -> None:
        """A tick has given an answer.

        Args:
            size: keyframes and edges of the graph.
            closures: of them closures.
        """
        if self._rates is not None:
            self._saved -= size * (self._rates.with_closures if closures > self._closures else 1)
        self._closures = closures

    def told(self) -> str:
        """What the user is told beforehand, in a line."""
        every = f"a tick every {self.period_ns / NANOSECONDS:g} s of the bag's time"
        if self._rates is None:
            return every
        rates = self._rates
        return (
            f"{every}, less often where the graph is large: {rates.per_second} units of work a second, one for each "
            f"keyframe and edge, {rates.with_closures} where closures came; -p solve_period_s:=S sets it"
        )
