"""Inputs from outside, and why they may be refused."""

from __future__ import annotations

import hashlib
import math
import operator
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Any

from rotavg_ros.errors import UserError
from rotavg_ros.online import quaternion
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.view_graph import UNIT_NORM_TOLERANCE, EdgeKind

MAX_ID = 2**64 - 1
# The id of an edge that the estimator itself makes between consecutive keyframes of an odometry.
OWN_EDGE_ID = MAX_ID
# Stamps are signed 64-bit nanoseconds; negative ones are free to mean "unknown".
MAX_STAMP_NS = 2**63 - 1
UNKNOWN_STAMP_NS = -1
_LARGEST_REFINEMENT = math.radians(10.0)


class RejectReason(str, Enum):
    """Why an input changed nothing. Every refused input is counted under exactly one of these."""

    NAN_ROTATION = "nan_rotation"
    ZERO_QUATERNION = "zero_quaternion"
    UNNORMALIZED_QUATERNION = "unnormalized_quaternion"
    SELF_EDGE = "self_edge"
    UNKNOWN_KEYFRAME = "unknown_keyframe"
    STAMP_OUT_OF_RANGE = "stamp_out_of_range"
    ODOMETRY_GAP = "odometry_gap"
    BAD_STAMP = "bad_stamp"
    NO_ORIENTATION = "no_orientation"
    OUT_OF_ORDER_ODOMETRY = "out_of_order_odometry"
    REPEATED_STAMP = "repeated_stamp"
    FUTURE_STAMP = "future_stamp"
    ODOMETRY_JUMP = "odometry_jump"
    ID_OUT_OF_RANGE = "id_out_of_range"
    BAD_KIND = "bad_kind"
    BAD_PRECISION = "bad_precision"
    BAD_REFERENCE = "bad_reference"
    DUPLICATE_EDGE = "duplicate_edge"
    CONTRADICTORY_ODOMETRY = "contradictory_odometry"
    PENDING_OVERFLOW = "pending_overflow"
    PENDING_TIMEOUT = "pending_timeout"
    GRAPH_FULL = "graph_full"
    MARGINALIZED_KEYFRAME = "marginalized_keyframe"
    WRONG_LENGTH = "wrong_length"
    MALFORMED_MESSAGE = "malformed_message"


class RejectedInputError(Exception):
    """An input is refused; it must have changed nothing."""

    def __init__(self, reason: RejectReason) -> None:
        super().__init__(reason.value)
        self.reason = reason


@dataclass(frozen=True, slots=True)
class OdometryMessage:
    """A robot's odometry at a moment.

    Attributes:
        robot: the robot's name.
        stamp_ns: nanoseconds.
        world_from_body: xyzw, the body in the odometry's frame.
        position: metres; None or not finite where unknown.
        body_from_sensor: xyzw, of the sensor at whose zero pose the odometry begins.
    """

    robot: str
    stamp_ns: int
    world_from_body: Sequence[float]
    position: Sequence[float] | None
    body_from_sensor: Sequence[float] = quaternion.IDENTITY


@dataclass(frozen=True, slots=True)
class KeyframeReference:
    """One end of an edge: a keyframe's id, or a moment of a robot.

    Attributes:
        robot: the robot's name.
        keyframe_id: identifies the keyframe when given; ``stamp_ns`` is then its stamp, for information.
        stamp_ns: nanoseconds in the robot's (or the bag's) clock; alone it means "the body at this moment".
    """

    robot: str
    keyframe_id: int | None = None
    stamp_ns: int | None = None

    @property
    def key(self) -> tuple[str, bool, int | None]:
        """What identifies the end: equal for equal ends."""
        by_id = self.keyframe_id is not None
        return (self.robot, by_id, self.keyframe_id if by_id else self.stamp_ns)


@dataclass(frozen=True, slots=True)
class EdgeMeasurement:
    """A measured relative rotation as a front end sends it.

    Attributes:
        edge_id: the sender's, echoed with the flags; 0 … 2⁶⁴-1.
        source, target: the ends.
        target_from_source: xyzw, ``R_target R_source⁻¹`` of the body-from-world orientations; :meth:`from_ros` takes
            its inverse, which ROS and g2o state.
        kind: an :class:`EdgeKind` value.
        precision: rad⁻²; 0 is unknown. An edge with a negative or non-finite precision is refused (a sender that gets
            its own covariance wrong cannot be trusted with the rotation).
        translation: of the target's body in the source's body frame, metres; None unknown. Edges without one are
            usual, so a non-finite one merely counts as unknown.
    """

    edge_id: int
    source: KeyframeReference
    target: KeyframeReference
    target_from_source: Sequence[float]
    kind: int = EdgeKind.LOOP_CLOSURE
    precision: float = 0.0
    translation: Sequence[float] | None = None

    @classmethod
    def from_ros(
        cls,
        edge_id: int,
        source: KeyframeReference,
        target: KeyframeReference,
        source_from_target: Sequence[float],
        translation: Sequence[float] | None = None,
        precision: float = 0.0,
    ) -> EdgeMeasurement:
        """A loop closure as ROS, g2o and GTSAM define one: by the target's pose in the source's frame.

        Where the target looks 30° to the left of the source, ``source_from_target`` is (0, 0, 0.2588, 0.9659); the
        attribute ``target_from_source`` is its inverse. For odometry: ``dataclasses.replace(edge, kind=…)``.

        Args:
            source_from_target: xyzw, orientation of the target in the source's frame.
            translation: position of the target in the source's frame, metres.
            precision: rad⁻², 0 unknown.
        """
        x, y, z, w = source_from_target
        target_from_source = quaternion.inverse((x, y, z, w))
        return cls(edge_id, source, target, target_from_source, precision=precision, translation=translation)

    def has_moment_of(self, robot: str) -> bool:
        """Whether one of its ends is a stamp of this robot."""
        return any(end.robot == robot and end.keyframe_id is None for end in (self.source, self.target))

    def fingerprint(self, time_lines: tuple[int, int] = (0, 0)) -> int:
        """64 bits that agree for a retransmission (same id, ends and rotation) and, in practice, for nothing else.

        Args:
            time_lines: numbers of the time lines that the ends' stamps belong to, 0 for an end by keyframe id.
        """
        keys = (self.source.key, self.target.key)
        ends = repr((*keys, *time_lines) if any(time_lines) else keys).encode("utf-8", "surrogatepass")
        numbers = struct.pack("<Q4d", self.edge_id, *self.target_from_source)
        return int.from_bytes(hashlib.blake2b(numbers + ends, digest_size=8).digest(), "little")


def checked_rotation(xyzw: Sequence[float]) -> Quaternion:
    """The unit quaternion with w ≥ 0, from one within 1e-3 of unit length.

    Raises:
        RejectedInputError: not four numbers, not finite, zero, or far from unit length.
    """
    check_length(xyzw, 4)
    x, y, z, w = map(float, xyzw)
    length = quaternion.norm((x, y, z, w))
    if not math.isfinite(length):
        raise RejectedInputError(RejectReason.NAN_ROTATION)
    if abs(length - 1) > UNIT_NORM_TOLERANCE:
        zero = length < UNIT_NORM_TOLERANCE
        raise RejectedInputError(RejectReason.ZERO_QUATERNION if zero else RejectReason.UNNORMALIZED_QUATERNION)
    return quaternion.normalize((x, y, z, w))


def contradict(known: Quaternion, repeated: Sequence[float]) -> bool:
    """Whether two rotations of odometry between the same keyframes are not one and its refinement."""
    return quaternion.angle_between(known, quaternion.normalize(repeated)) > _LARGEST_REFINEMENT


def check_length(numbers: Sequence[float] | None, length: int) -> None:
    """Refuse numbers of another length; None is accepted.

    Raises:
        RejectedInputError: the length differs.
    """
    if numbers is not None and len(numbers) != length:
        raise RejectedInputError(RejectReason.WRONG_LENGTH)


def checked_stamp(stamp_ns: int) -> int:
    """The stamp, if it is valid.

    Raises:
        RejectedInputError: negative or beyond 64 bits.
    """
    if not 0 <= stamp_ns <= MAX_STAMP_NS:
        raise RejectedInputError(RejectReason.BAD_STAMP)
    return stamp_ns


def whole_number(name: str, number: Any) -> int:
    """A number as Python's own integer, since JSON cannot represent NumPy's.

    Raises:
        UserError: it is no whole number; one that is cut to a whole one would be another keyframe's, or another edge's.
    """
    try:
        return operator.index(number)
    except TypeError:
        raise UserError(f"{name} is {number!r}; give a whole number, such as int({name})") from None


def whole_nanoseconds(stamp: Any) -> int:
    """A stamp as Python's own integer.

    Raises:
        UserError: it is no whole number: seconds, perhaps.
    """
    try:
        return operator.index(stamp)
    except TypeError:
        raise UserError(f"stamp_ns is {stamp!r}; give whole nanoseconds, such as round(1e9 * seconds)") from None


def plain_numbers(numbers: Sequence[float] | None) -> tuple[float, ...] | None:
    """Several numbers as Python's own; a tuple, unlike an array, can be tested for truth."""
    return None if numbers is None else tuple(map(float, numbers))


def _plain_end(end: KeyframeReference) -> KeyframeReference:
    """An end with Python's own integers; raises UserError if a number is no whole one."""
    return KeyframeReference(
        end.robot,
        None if end.keyframe_id is None else whole_number("keyframe_id", end.keyframe_id),
        None if end.stamp_ns is None else whole_nanoseconds(end.stamp_ns),
    )


def checked_edge(edge: EdgeMeasurement) -> EdgeMeasurement:
    """Check everything about an edge that can be judged without knowing the graph.

    Returns:
        the edge with ``target_from_source`` normalised and Python's own numbers.

    Raises:
        RejectedInputError: with the first reason that applies.
        UserError: an id or a stamp is no whole number.
    """
    edge_id, source, target = whole_number("edge_id", edge.edge_id), _plain_end(edge.source), _plain_end(edge.target)
    if edge.kind not in (EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE):
        raise RejectedInputError(RejectReason.BAD_KIND)
    if not (math.isfinite(edge.precision) and edge.precision >= 0):
        raise RejectedInputError(RejectReason.BAD_PRECISION)
    for reference in (source, target):
        if reference.keyframe_id is None and reference.stamp_ns is None:
            raise RejectedInputError(RejectReason.BAD_REFERENCE)
        if reference.keyframe_id is not None and not 0 <= reference.keyframe_id <= MAX_ID:
            raise RejectedInputError(RejectReason.ID_OUT_OF_RANGE)
        if reference.stamp_ns is not None:
            checked_stamp(reference.stamp_ns)
    if not 0 <= edge_id <= MAX_ID:
        raise RejectedInputError(RejectReason.ID_OUT_OF_RANGE)
    if source.key == target.key:
        raise RejectedInputError(RejectReason.SELF_EDGE)
    check_length(edge.translation, 3)
    return replace(
        edge,
        edge_id=edge_id,
        source=source,
        target=target,
        target_from_source=checked_rotation(edge.target_from_source),
        kind=int(edge.kind),
        precision=float(edge.precision),
        translation=plain_numbers(edge.translation),
    )
