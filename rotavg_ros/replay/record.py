"""A replay's results in memory: everything that its outputs and the report are made from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import Answer


@dataclass(frozen=True)
class TickRecord:
    """One answer during the replay.

    Attributes:
        stamp_ns: bag time.
        seconds: duration of the tick.
        was_cold: whether it was solved from scratch.
        keyframes, edges, outliers: their numbers.
        flips: number of edges whose outlier flag has changed since the answer before; new edges do not count.
    """

    stamp_ns: int
    seconds: float
    was_cold: bool
    keyframes: int
    edges: int
    outliers: int
    flips: int


@dataclass(frozen=True)
class TopicUse:
    """A topic of the bag and its use in the replay.

    Attributes:
        topic, type_name: e.g. ``/odom``, ``nav_msgs/msg/Odometry``.
        messages: number of its messages in the bag.
        used_as: e.g. ``odometry of robot``, ``loop closures``, ``reference``; empty: not used.
        why_not: why it is not used; empty if there is nothing to explain.
    """

    topic: str
    type_name: str
    messages: int
    used_as: str
    why_not: str = ""


def positions_told(position: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Positions ``(r, 3)``, NaN rows where unknown; None if none is known, or all are the same.

    A message has no way to say that its sender knows orientations alone, so such senders leave all positions at zero.
    """
    known = position[np.isfinite(position).all(axis=1)]
    return position if len(known) and bool(np.ptp(known, axis=0).any()) else None


@dataclass(frozen=True)
class Reference:
    """A robot's poses from another source (r poses, ascending stamps): ground truth, or a check.

    Attributes:
        name: the topic or the file.
        stamp_ns: ``(r,)`` int64, on the bag's clock; ascending within a time line.
        world_from_body: ``(r, 4)`` xyzw, in a world of its own.
        position: ``(r, 3)`` metres; None if it has none.
        time_line: ``(r,)`` int64, as for a robot's keyframes; None: a single one, which stands for all of the robot's.
    """

    name: str
    stamp_ns: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    position: NDArray[np.float64] | None
    time_line: NDArray[np.int64] | None = None

    def on_time_line(self, time_line: int, num_time_lines: int) -> Reference | None:
        """The part that belongs to one of a robot's time lines; None if that is not known.

        If its own stamps went back as often as the robot's, their time lines correspond; if not, only the last do.
        """
        if self.time_line is None:
            return self
        last = int(self.time_line.max(initial=0))
        if time_line == num_time_lines - 1:
            return self.on_last_time_line()
        return self._chosen(self.time_line == time_line) if num_time_lines == last + 1 else None

    def on_last_time_line(self) -> Reference:
        """The part since its stamps last went back."""
        return self if self.time_line is None else self._chosen(self.time_line == self.time_line.max(initial=0))

    def _chosen(self, rows: NDArray[np.bool_]) -> Reference:
        position = None if self.position is None else self.position[rows]
        return Reference(self.name, self.stamp_ns[rows], self.world_from_body[rows], position)


@dataclass(frozen=True)
class RobotRecord:
    """A robot's keyframes in the last answer in order of time (n of them).

    Attributes:
        robot: its name.
        nodes: ``(n,)`` int64 indices into the answer's keyframes.
        stamp_ns: ``(n,)`` int64; ascending within a time line.
        time_line: ``(n,)`` int64; a new one begins where the robot's clock went back.
        keyframe_id: ``(n,)`` uint64.
        odometry_world_from_body: ``(n, 4)`` xyzw, in odometry's frame; NaN rows without odometry.
        odometry_position: ``(n, 3)`` metres in odometry's frame; None without positions.
        world_from_body: ``(n, 4)`` xyzw, corrected.
        position_dead_reckoned: ``(n, 3)`` metres, odometry's steps along the corrected orientations; None: unknown.
        position: ``(n, 3)`` metres, least squares over the translations of odometry and inlier closures; None: unknown.
        uncertainty: ``(n,)`` one sigma of the orientation in radians, NaN unknown.
        reference: to compare with; None without.
    """

    robot: str
    nodes: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
    time_line: NDArray[np.int64]
    keyframe_id: NDArray[np.uint64]
    odometry_world_from_body: NDArray[np.float64]
    odometry_position: NDArray[np.float64] | None
    world_from_body: NDArray[np.float64]
    position_dead_reckoned: NDArray[np.float64] | None
    position: NDArray[np.float64] | None
    uncertainty: NDArray[np.float64]
    reference: Reference | None = None


@dataclass(frozen=True)
class RunRecord:
    """A whole replay.

    Attributes:
        name: name of the bag.
        duration_s: duration of the replayed part, in bag time.
        answer: the last one; a cold solve.
        robots: those with keyframes that have stamps.
        ticks: in order.
        topics: every topic of the bag, by name.
        rejected: inputs refused, by :class:`~rotavg_ros.online.RejectReason` value.
        options: the parameters as users write them, by the node's names.
        wall_seconds: duration of the replay.
        interrupted: whether it was stopped by Ctrl-C, or by damage to the bag, before its end.
        warnings: about how the bag was read, edges that were not used, and references that do not fit.
        damage: what could not be read of the bag; None: nothing.
    """

    name: str
    duration_s: float
    answer: Answer
    robots: tuple[RobotRecord, ...]
    ticks: tuple[TickRecord, ...]
    topics: tuple[TopicUse, ...]
    rejected: dict[str, int]
    options: dict[str, object]
    wall_seconds: float
    interrupted: bool
    warnings: tuple[str, ...] = ()
    damage: str | None = None
