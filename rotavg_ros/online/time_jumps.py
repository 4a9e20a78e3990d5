"""A clock that went back (a bag that begins again, a simulation that restarts), told from messages that come late."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

# So many messages in a row must agree before the past is believed: stray ones, however old, change nothing.
_RUN_LENGTH = 5

POLICIES = ("reset", "ignore", "error")


@dataclass(frozen=True, slots=True)
class LateMessage:
    """An odometry message stamped before the one that came before it; the fields of ``add_odometry``."""

    robot: str
    stamp_ns: int
    world_from_body: Sequence[float]
    position: Sequence[float] | None


class BackwardJumps:
    """Collects late messages until they show that time runs on from an earlier moment."""

    def __init__(self) -> None:
        self._runs: dict[str, list[LateMessage]] = {}
        self._told: set[str] = set()

    def late(self, message: LateMessage, latest_ns: int, threshold_ns: int, longest_step_ns: int) -> list[LateMessage]:
        """Note a message that was refused as out of order.

        Args:
            message: what was refused.
            latest_ns: newest stamp of its robot.
            threshold_ns: going back by no more than this is no jump.
            longest_step_ns: late messages farther apart do not belong together.

        Returns:
            the messages since the jump, in their order, once per jump; empty as long as there is no telling.
        """
        run = self._runs.setdefault(message.robot, [])
        if run and not 0 < message.stamp_ns - run[-1].stamp_ns <= longest_step_ns:
            run.clear()
        if message.robot not in self._told and latest_ns - message.stamp_ns > threshold_ns:
            run.append(message)
        if len(run) < _RUN_LENGTH:
            return []
        self._told.add(message.robot)
        return self._runs.pop(message.robot)

    def on_time(self, robot: str) -> None:
        """Note a message that came in order: time runs on as before."""
        self._runs.pop(robot, None)
        self._told.discard(robot)

    @property
    def is_back(self) -> bool:
        """Whether a robot's messages have come from before a jump ever since."""
        return bool(self._told)
