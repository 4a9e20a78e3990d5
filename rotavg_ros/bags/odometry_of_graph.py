"""Which of a bag's odometry messages become keyframes of its graph: those that the online estimator would take."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.bags.reader import BagReadError
from rotavg_ros.bags.topics import ODOM_TOPIC
from rotavg_ros.online import EstimatorOptions
from rotavg_ros.online.measurements import RejectedInputError, RejectReason
from rotavg_ros.online.odometry.data_time import DataTime
from rotavg_ros.online.odometry.time_jumps import RUN_LENGTH
from rotavg_ros.online.odometry.track import OdometryTrack
from rotavg_ros.stamps import NANOSECONDS
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE

# Stamp in ns, position, world-from-body xyzw.
Pose = tuple[int, list[float], list[float]]

_WHY_LEFT_OUT = {
    RejectReason.REPEATED_STAMP: "odometry messages with the stamp of the one before",
    RejectReason.OUT_OF_ORDER_ODOMETRY: "odometry messages out of order",
    RejectReason.FUTURE_STAMP: "odometry messages far ahead of the others",
    RejectReason.ODOMETRY_JUMP: "odometry messages that jump away from the others",
}


def taken_messages(odometry: list[Pose]) -> tuple[list[Pose], NDArray[np.int64], dict[str, int]]:
    """The messages that the estimator would take, by its own rule and in the order of recording.

    Args:
        odometry: all messages of one time line, see :func:`check_time`.

    Returns:
        n messages, ascending in time; ``(n,)`` number of the chain of each, from 0; and how many were left out, by why.
        Between two chains the motion is unknown, since odometry has begun anew.
    """
    options = EstimatorOptions()
    track = OdometryTrack(options.odometry_bounds, options.continuity_limits)
    taken: list[Pose] = []
    chain: list[int] = []
    left_out: Counter[str] = Counter()
    for message in odometry:
        stamp_ns, position, rotation = message
        if not is_sound(message):
            left_out["odometry messages without a pose"] += 1
            continue
        try:
            track.add(stamp_ns, rotation, position)
        except RejectedInputError as rejection:
            left_out[_WHY_LEFT_OUT[rejection.reason]] += 1
            continue
        taken.append(message)
        chain.append(track.chain)
    return taken, np.array(chain, dtype=np.int64), dict(left_out)


def check_time(path: str | Path, odometry: list[Pose]) -> None:
    """Refuse odometry whose time goes back: a graph's stamps could not tell its two times apart.

    Messages that are the same as one before are no harm, as in a recording of a bag in a loop, nor are stray ones.

    Raises:
        BagReadError: time goes back.
    """
    options, time, known = EstimatorOptions(), DataTime(), set[tuple[float, ...]]()
    run: dict[tuple[float, ...], int] = {}  # messages that are back, one after the other, and their rows
    for row, (stamp_ns, position, rotation) in enumerate(odometry):
        message = (stamp_ns, *position, *rotation)
        now_ns = time.advance(stamp_ns, options.continuity_limits.lead_ns)
        if now_ns is not None:
            time.claimed_ns = None  # only the next message may confirm a stamp far ahead
        back_ns = 0 if now_ns is None else now_ns - stamp_ns
        if message in run:
            continue  # it comes twice
        if back_ns <= options.time_jump_ns or message in known:
            run.clear()
        else:
            run[message] = row
        known.add(message)
        if len(run) == RUN_LENGTH:
            first = next(iter(run.values()))
            raise BagReadError(
                f"{path}: {ODOM_TOPIC}: time goes back by {back_ns / NANOSECONDS:.1f} s after {first} "
                "messages, and a graph has room for one time; `rotavg replay` reads the bag, with a component for each"
            )


def is_oriented(message: Pose) -> bool:
    """Whether the orientation is a rotation."""
    return abs(float(np.linalg.norm(message[2])) - 1) <= UNIT_NORM_TOLERANCE


def is_sound(message: Pose) -> bool:
    """Whether stamp, orientation and position are ones."""
    return message[0] >= 0 and is_oriented(message) and bool(np.isfinite(message[1]).all())
