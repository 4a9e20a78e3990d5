"""A clock that went back (a bag that begins again, a simulation that restarts), told from messages that come late."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.measurements import OdometryMessage

# So many messages in a row must agree before the past is believed: stray ones, however old, change nothing.
_RUN_LENGTH = 5
# They follow each other if no step among them is longer than so many of the robot's own: 5 s at 10 Hz. With fewer a
# pause in the wrong moment costs the messages before it; stray stamps lie so much farther apart that more would do.
_LONGEST_STEP = 50.0
# The robot's own step is exceeded by a tenth of its latest: a few pauses do not count, and the pauses between messages
# that come in bursts do. Of that many messages.
RECENT = 100
_USUAL = 0.9

POLICIES = ("new_component", "reset", "ignore", "error")
# With these a robot's stamps mean what they did before, whatever its clock says.
KEEPS_TIME_LINE = ("ignore", "error")


class BackwardJumps:
    """Collects late messages until they show that time runs on from an earlier moment."""

    def __init__(self) -> None:
        self._runs: dict[str, list[OdometryMessage]] = {}
        self._told: set[str] = set()

    def late(self, message: OdometryMessage, taken_ns: NDArray[np.int64], threshold_ns: int) -> list[OdometryMessage]:
        """Note a message that was refused as out of order.

        Args:
            message: what was refused.
            taken_ns: ``(n,)`` stamps of its robot's messages that were taken, the newest last, of the latest
                :data:`RECENT` or more; at least one.
            threshold_ns: going back by no more than this is no jump.

        Returns:
            the messages since the jump, in their order, once per jump; empty as long as there is no telling.
        """
        run = self._runs.setdefault(message.robot, [])
        if run and not 0 < message.stamp_ns - run[-1].stamp_ns <= _longest_step_ns(taken_ns[-RECENT:]):
            run.clear()
        if message.robot not in self._told and int(taken_ns[-1]) - message.stamp_ns > threshold_ns:
            run.append(message)
        if len(run) < _RUN_LENGTH:
            return []
        self._told.add(message.robot)
        return self._runs.pop(message.robot)

    def on_time(self, robot: str) -> None:
        """Note a message that came in order: time runs on as before."""
        self._runs.pop(robot, None)
        self._told.discard(robot)

    def is_undecided(self, robot: str) -> bool:
        """Whether late messages that follow each other have come, but too few to believe that time went back."""
        return len(self._runs.get(robot, ())) >= 2

    def header(self) -> dict[str, Any]:
        """Everything, as JSON can say it, for :meth:`from_header`."""
        runs = {
            robot: [
                [message.stamp_ns, list(map(float, message.world_from_body)), message.position and [*message.position]]
                for message in run
            ]
            for robot, run in self._runs.items()
        }
        return {"runs": runs, "told": sorted(self._told)}

    @classmethod
    def from_header(cls, header: dict[str, Any]) -> BackwardJumps:
        """The late messages that :meth:`header` came from."""
        jumps = cls()
        jumps._runs = {robot: [OdometryMessage(robot, *row) for row in run] for robot, run in header["runs"].items()}
        jumps._told = set(header["told"])
        return jumps

    @property
    def is_back(self) -> bool:
        """Whether a robot's messages have come from before a jump ever since."""
        return bool(self._told)


def _longest_step_ns(taken_ns: NDArray[np.int64]) -> float:
    """Late messages of a robot with these stamps ``(n,)`` that lie farther apart do not belong together."""
    steps = np.diff(taken_ns)
    steps = steps[steps > 0]  # where time went back before, there is a step back
    return _LONGEST_STEP * float(np.quantile(steps, _USUAL)) if len(steps) else math.inf
