"""What a replay leaves behind, in memory: everything its outputs and the report are made of."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online import Answer


@dataclass(frozen=True)
class TickRecord:
    """One answer on the way.

    Attributes:
        stamp_ns: bag time.
        seconds: that the tick took.
        was_cold: solved from scratch.
        keyframes, edges, outliers: sizes.
        flips: edges whose outlier flag is another than one answer ago; new edges do not count.
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
    """A topic of the bag and its part in the replay.

    Attributes:
        topic, type_name: e.g. ``/odom``, ``nav_msgs/msg/Odometry``.
        messages: how many the bag has.
        used_as: e.g. ``odometry of robot``, ``loop closures``, ``reference``; empty: not used.
        why_not: of an unused topic; empty where there is nothing to explain.
    """

    topic: str
    type_name: str
    messages: int
    used_as: str
    why_not: str = ""


@dataclass(frozen=True)
class Reference:
    """Where somebody else says a robot was (r poses, ascending stamps): ground truth, or a check.

    Attributes:
        name: the topic or the file.
        stamp_ns: ``(r,)`` int64, on the bag's clock.
        world_from_body: ``(r, 4)`` xyzw, in a world of its own.
        position: ``(r, 3)`` metres; None where it states none.
    """

    name: str
    stamp_ns: NDArray[np.int64]
    world_from_body: NDArray[np.float64]
    position: NDArray[np.float64] | None


@dataclass(frozen=True)
class RobotRecord:
    """A robot's keyframes in the last answer in order of time (n of them).

    Attributes:
        robot: its name.
        nodes: ``(n,)`` int64 indices into the answer's keyframes.
        stamp_ns: ``(n,)`` int64.
        keyframe_id: ``(n,)`` uint64.
        odometry_world_from_body: ``(n, 4)`` xyzw, in odometry's frame; NaN rows without odometry.
        odometry_position: ``(n, 3)`` metres in odometry's frame; None without positions.
        world_from_body: ``(n, 4)`` xyzw, corrected.
        position_dead_reckoned: ``(n, 3)`` metres, odometry's steps along the corrected orientations; None without.
        position: ``(n, 3)`` metres, least squares over odometry's and surviving closures' translations; None without.
        uncertainty: ``(n,)`` one sigma of the orientation in radians, NaN unknown.
        reference: to compare with; None without.
    """

    robot: str
    nodes: NDArray[np.int64]
    stamp_ns: NDArray[np.int64]
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
        name: of the bag.
        duration_s: of the replayed part, in bag time.
        answer: the last one; a cold solve.
        robots: those with keyframes that have stamps.
        ticks: in order.
        topics: every topic of the bag, by name.
        rejected: inputs refused, by :class:`~rotavg_ros.online.RejectReason` value.
        options: the parameters, by the node's names.
        wall_seconds: that the replay took.
        interrupted: stopped by Ctrl-C, or by damage to the bag, before its end.
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
