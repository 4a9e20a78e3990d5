"""A whole solve that runs beside updates, some of its steps at each: the tick that needs one does not wait for it."""

from __future__ import annotations

from rotavg_ros.solver.algebra.running import Steps, metered
from rotavg_ros.solver.estimate import Estimate


class WholeSolve:
    """Of the graph as it was when the solve began.

    Attributes:
        has_failed: a step did not come to its end, as where a tick is abandoned; it cannot be gone on with.
    """

    def __init__(self, steps: Steps[Estimate]) -> None:
        self._steps = steps
        self.has_failed = False

    def go_on(self, units: float) -> Estimate | None:
        """Do at least one step, and more until they have cost so many units of work; the estimate at the end."""
        with metered() as meter:
            while True:
                try:
                    next(self._steps)
                except StopIteration as end:
                    estimate: Estimate = end.value
                    return estimate
                except BaseException:
                    self.has_failed = True
                    raise
                if meter.spent >= units:
                    return None
