"""The page's tables: closures, errors, topics, refusals, options."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.measurements import RejectReason
from rotavg_ros.replay.record import TopicUse
from rotavg_ros.reports.facts import Closure, RunFacts

WHY_REFUSED = {
    RejectReason.NAN_ROTATION: "the rotation holds NaN or infinity",
    RejectReason.ZERO_QUATERNION: "the quaternion is zero; often a field that the sender never filled",
    RejectReason.UNNORMALIZED_QUATERNION: "the quaternion is farther than 0.001 from unit length",
    RejectReason.SELF_EDGE: "both ends are the same keyframe",
    RejectReason.UNKNOWN_KEYFRAME: "the edge names a keyframe that never came",
    RejectReason.STAMP_OUT_OF_RANGE: "the edge's stamp lies outside the odometry (stamp_tolerance_s)",
    RejectReason.ODOMETRY_GAP: "the edge's stamp lies in a gap of the odometry (max_odometry_gap_s)",
    RejectReason.BAD_STAMP: "the stamp is negative or does not fit into 64 bits",
    RejectReason.NO_ORIENTATION: "the device says that it estimates no orientation",
    RejectReason.FUTURE_STAMP: "a stamp far ahead of the last that no second message confirmed (max_stamp_lead_s)",
    RejectReason.ODOMETRY_JUMP: "odometry that no robot could drive or turn (max_turn_rate_deg_s, max_speed_m_s)",
    RejectReason.OUT_OF_ORDER_ODOMETRY: "an odometry message is older than the one before it",
    RejectReason.REPEATED_STAMP: "an odometry message has the stamp of the one before it",
    RejectReason.ID_OUT_OF_RANGE: "an id does not fit into 64 bits",
    RejectReason.BAD_KIND: "the edge is neither odometry nor a loop closure",
    RejectReason.BAD_PRECISION: "the precision is negative or not finite",
    RejectReason.BAD_REFERENCE: "an end of the edge has neither an id nor a stamp",
    RejectReason.DUPLICATE_EDGE: "the same edge came before; it counts once",
    RejectReason.CONTRADICTORY_ODOMETRY: "a front end says another step between the same keyframes; it began anew?",
    RejectReason.PENDING_OVERFLOW: "too many edges were waiting for their keyframes (pending_capacity)",
    RejectReason.PENDING_TIMEOUT: "an edge waited too long for its keyframe (pending_timeout_s)",
    RejectReason.GRAPH_FULL: "the graph has as many edges as it may have (max_edges, max_keyframes), and none to spare",
    RejectReason.MARGINALIZED_KEYFRAME: "the keyframe was taken out of a full graph too long ago (max_keyframes)",
    RejectReason.WRONG_LENGTH: "a rotation that is not four numbers, or a position that is not three",
    RejectReason.MALFORMED_MESSAGE: "a message that ends too early; was its sender built with other definitions?",
}


class Column(NamedTuple):
    """A column's name and the style of its cells: ``number``, ``code`` or plain."""

    name: str
    kind: str = ""


@dataclass(frozen=True)
class Row:
    """The cells of a row. Text is escaped by the template."""

    cells: tuple[str, ...]
    flagged: bool = False


@dataclass(frozen=True)
class Table:
    """A table.

    Attributes:
        folded: heading of the fold that hides the table; empty: not folded.
    """

    columns: Sequence[Column]
    rows: Sequence[Row]
    folded: str = ""


def closure_table(closures: Sequence[Closure], facts: RunFacts, folded: str = "") -> Table:
    """Loop closures with their residuals and both their ends: robot, keyframe and time."""
    in_metres = [Column("off by, m", "number")] if facts.knows_places else []
    columns = [
        Column("verdict"),
        Column("score", "number"),
        Column("off by, °", "number"),
        *in_metres,
        Column("id", "number"),
        Column("source"),
        Column("its stamp, s", "number"),
        Column("since start, s", "number"),
        Column("target"),
        Column("its stamp, s", "number"),
        Column("since start, s", "number"),
    ]
    rows = [
        Row(
            (
                f"false: {closure.fails}" if closure.outlier else "believed",
                f"{closure.score:.3f}",
                f"{closure.off_deg:.1f}",
                *([_metres(closure.off_m)] if facts.knows_places else []),
                "–" if closure.edge_id is None else str(closure.edge_id),
                *_end(closure.source, facts),
                *_end(closure.target, facts),
            ),
            closure.outlier,
        )
        for closure in closures
    ]
    return Table(columns, rows, folded)


def _metres(value: float) -> str:
    return f"{value:.2f}" if np.isfinite(value) else "–"


def _end(end: tuple[str, int, int], facts: RunFacts) -> tuple[str, str, str]:
    robot, keyframe_id, stamp_ns = end
    name = f"{robot} {keyframe_id}" if len(facts.record.answer.robots) > 1 else str(keyframe_id)
    if stamp_ns < 0:
        return name, "–", "–"
    return name, f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}", f"{facts.seconds(np.int64(stamp_ns)):.2f}"


def error_table(facts: RunFacts) -> Table:
    """Errors against the reference, a row per robot and quantity."""
    columns = [
        Column("robot"),
        Column("what"),
        Column("mean", "number"),
        Column("median", "number"),
        Column("root mean square", "number"),
        Column("largest", "number"),
    ]
    rows: list[Row] = []
    for robot, errors in facts.compared:
        for what, values, factor, unit in (
            ("orientation, odometry alone", errors.odometry.angle, np.degrees(1.0), "°"),
            ("orientation, corrected", errors.corrected.angle, np.degrees(1.0), "°"),
            ("… one standard deviation about each axis, as stated", robot.uncertainty, np.degrees(1.0), "°"),
            ("position, odometry alone", errors.odometry_distance, 1.0, " m"),
            ("position, odometry's steps along corrected orientations", errors.dead_reckoned_distance, 1.0, " m"),
            ("position, corrected", errors.corrected_distance, 1.0, " m"),
        ):
            known = values[np.isfinite(values)] * factor
            if len(known):
                rows.append(Row((robot.robot, what, *(f"{value:.2f}{unit}" for value in _summary(known)))))
    return Table(columns, rows)


def _summary(values: NDArray[np.float64]) -> tuple[float, float, float, float]:
    return (
        float(values.mean()),
        float(np.median(values)),
        float(np.sqrt(np.mean(values**2))),
        float(values.max()),
    )


def rejection_table(rejected: dict[str, int]) -> Table:
    """Refused inputs by reason, the most frequent first."""
    why = {reason.value: text for reason, text in WHY_REFUSED.items()}
    rows = [
        Row((reason, str(count), why.get(reason, "")))
        for reason, count in sorted(rejected.items(), key=lambda item: (-item[1], item[0]))
        if count
    ]
    return Table([Column("reason", "code"), Column("messages", "number"), Column("which means")], rows)


def topic_table(topics: Sequence[TopicUse]) -> Table:
    """Every topic of the bag, those that were used first."""
    rows = [
        Row((topic.topic, topic.type_name, str(topic.messages), topic.used_as or "ignored", topic.why_not))
        for topic in sorted(topics, key=lambda topic: (not topic.used_as, topic.topic))
    ]
    columns = [
        Column("topic", "code"),
        Column("type", "code"),
        Column("messages", "number"),
        Column("used as"),
        Column("why not"),
    ]
    return Table(columns, rows)


def stage_table(facts: RunFacts) -> Table:
    """Durations of the last solve's stages."""
    answer = facts.record.answer
    rows = [Row((stage, f"{1000 * seconds:.1f}")) for stage, seconds in answer.stage_seconds.items()]
    return Table([Column("stage of the last solve"), Column("milliseconds", "number")], rows, "The last solve's stages")


def option_table(options: dict[str, object]) -> Table:
    """The options of the run."""
    rows = [Row((name, _shown(value))) for name, value in options.items()]
    return Table([Column("option", "code"), Column("value", "code")], rows, "All options of this run")


def _shown(value: object) -> str:
    if isinstance(value, float):
        return f"{value:g}"
    if isinstance(value, (list, tuple)):
        return ", ".join(_shown(item) for item in value) or "–"
    return "–" if value is None or value == "" else str(value)
