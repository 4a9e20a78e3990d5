"""Detects a clock that went back (a bag that begins again, a simulation that restarts) from late messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.measurements import OdometryMessage

# Number of messages in a row that must agree before a jump is believed: stray ones, however old, change nothing.
RUN_LENGTH = 5
# They count as consecutive if no step among them exceeds this many of the robot's usual steps: 5 s at 10 Hz. With a
# smaller number, a pause at the wrong moment loses the messages before it; a larger one would work as well, since stray
# stamps lie much farther apart.
_LONGEST_STEP = 50.0
# The robot's usual step is the 0.9 quantile of its steps, so that a few pauses do not count, but the pauses between
# bursts of messages do. The quantile is taken over this many of the latest messages.
RECENT = 100
_USUAL = 0.9

POLICIES = ("new_component", "reset", "ignore", "error")
# With these policies no new time line begins, so a robot's stamps keep their meaning whatever its clock says.
KEEPS_TIME_LINE = ("ignore", "error")


class BackwardJumps:
    """Collects late messages until they show that time runs on from an earlier moment."""

    def __init__(self) -> None:
        self._runs: dict[str, list[OdometryMessage]] = {}
        self._told: set[str] = set()

    def late(
        self, message: OdometryMessage, taken_ns: NDArray[np.int64], threshold_ns: int, policy: str
    ) -> list[OdometryMessage]:
        """Note a message that was refused as out of order.

        Args:
            message: the refused message.
            taken_ns: ``(n,)`` stamps of its robot's accepted messages, the newest last: the latest :data:`RECENT` or
                more if there are as many; at least one.
            threshold_ns: going back by no more than this is not a jump.
            policy: one of :data:`POLICIES`. With one that keeps the time line a jump is told once, until time goes on;
                with another it is told even if one of those has applied to it before.

        Returns:
            the messages since the jump, in order; empty as long as it is not certain, or if it has been told.
        """
        run = self._runs.setdefault(message.robot, [])
        if run and run[0].stamp_ns <= message.stamp_ns <= run[-1].stamp_ns:
            return []  # late by the new time as well: stamps of a coarse clock come twice
        if run and not 0 < message.stamp_ns - run[-1].stamp_ns <= _longest_step_ns(taken_ns[-RECENT:]):
            run.clear()
        is_told = policy in KEEPS_TIME_LINE and message.robot in self._told
        if not is_told and int(taken_ns[-1]) - message.stamp_ns > threshold_ns:
            run.append(message)
        if len(run) < RUN_LENGTH:
            return []
        self._told.add(message.robot)
        return self._runs.pop(message.robot)

    def on_time(self, robot: str) -> None:
        """Note a message that came in order: time goes on as before."""
        self._runs.pop(robot, None)
        self._told.discard(robot)

    def is_undecided(self, robot: str) -> bool:
        """Whether consecutive late messages have come, but too few to believe that time went back."""
        return len(self._runs.get(robot, ())) >= 2

    def header(self) -> dict[str, Any]:
        """Everything in a form that JSON can represent, for :meth:`from_header`."""
        runs = {
            robot: [
                [
                    message.stamp_ns,
                    list(map(float, message.world_from_body)),
                    message.position and [*message.position],
                    list(map(float, message.body_from_sensor)),
                ]
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
        """Whether a robot's clock went back and its messages have been late ever since."""
        return bool(self._told)


class TimeBefore:
    """Recognises odometry of a time that is forgotten: the clock went back while it was still under way."""

    def __init__(self, latest_ns: Mapping[str, int], until_ns: int, threshold_ns: int) -> None:
        """Remember where each robot's odometry was.

        Args:
            latest_ns: stamp of the last message of each robot.
            until_ns: what the clock showed before it went back.
            threshold_ns: going back by no more than this is not a jump.
        """
        self._latest_ns, self._until_ns, self._threshold_ns = dict(latest_ns), until_ns, threshold_ns

    def has(self, robot: str, stamp_ns: int) -> bool:
        """Whether a message belongs to it: until its robot's first that is back, or that the clock had not reached."""
        latest_ns = self._latest_ns.get(robot)
        if latest_ns is None:
            return False
        if latest_ns - self._threshold_ns <= stamp_ns <= self._until_ns + self._threshold_ns:
            return True
        del self._latest_ns[robot]
        return False


def _longest_step_ns(taken_ns: NDArray[np.int64]) -> float:
    """Longest step between consecutive late messages of a robot whose accepted messages have these stamps ``(n,)``."""
    steps = np.diff(taken_ns)
    steps = steps[steps > 0]  # steps are negative where time went back before
    return _LONGEST_STEP * float(np.quantile(steps, _USUAL)) if len(steps) else math.inf
