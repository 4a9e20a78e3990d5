"""Edges that still wait for what they refer to when a bag ends: no answer has them."""

from __future__ import annotations

from collections.abc import Collection

from rotavg_ros.online.content import Counts

# Most names that are shown.
_MOST_NAMES = 3


def told(counts: Counts, robots: Collection[str]) -> str | None:
    """How many there are, and what to do; None if there are none.

    Args:
        counts: at the end.
        robots: those with odometry in the replay, or whose edges create keyframes.
    """
    if not counts.pending:
        return None
    edges = "1 edge was not used: it is" if counts.pending == 1 else f"{counts.pending} edges were not used: they are"
    known = sorted({*robots, *counts.robots})
    unknown = sorted(set(counts.pending_by_robot).difference(known))
    if unknown:
        names = ", ".join(repr(robot) for robot in unknown[:_MOST_NAMES])
        return (
            f"{edges} about robots that are not known, such as {names}; known are {', '.join(map(repr, known))}: "
            "name them so with --robots, one per --odometry"
        )
    waits_for = counts.longest_pending
    if waits_for is not None and waits_for.keyframe_id is not None:
        return (
            f"{edges} about keyframes that never came, such as {waits_for.keyframe_id} of {waits_for.robot!r}; a "
            "sender that numbers keyframes by itself needs -p keyframe_source:=edges"
        )
    moment = "" if waits_for is None or waits_for.stamp_ns is None else f", such as {waits_for.stamp_ns / 1e9:.3f} s"
    return (
        f"{edges} of moments that the odometry taken does not reach{moment}; their stamps and the odometry's must come "
        "from one clock"
    )
