"""Messages to measurements and answers to messages: the one place where directions turn around.

A message carries an edge as the orientation of the target in the source frame (source_from_target), and absolute
orientations as world_from_body. Inside, an edge is target_from_source.
"""

from __future__ import annotations

from array import array
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion as QuaternionMessage
from numpy.typing import DTypeLike, NDArray
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags, RelativeRotation
from rotavg_msgs.msg import KeyframeReference as ReferenceMessage
from std_msgs.msg import Header

from rotavg_ros.online import Answer, EdgeMeasurement, KeyframeReference, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation
from rotavg_ros.online.quaternion import Quaternion

NANOSECONDS = 1_000_000_000


def to_nanoseconds(stamp: Time) -> int:
    """Nanoseconds of a message's stamp.

    Raises:
        RejectedInputError: the fraction is a second or more, or the stamp lies before 1970.
    """
    nanosec: int = stamp.nanosec
    seconds: int = stamp.sec
    if nanosec >= NANOSECONDS or seconds < 0:
        raise RejectedInputError(RejectReason.BAD_STAMP)
    return seconds * NANOSECONDS + nanosec


def to_time(stamp_ns: int) -> Time:
    """A message's stamp; what a Time cannot hold (unknown, or beyond 2038) becomes zero."""
    seconds, nanosec = divmod(stamp_ns, NANOSECONDS)
    return Time(sec=seconds, nanosec=nanosec) if 0 <= seconds < 2**31 else Time()


def to_tuple(rotation: QuaternionMessage) -> Quaternion:
    """The four numbers xyzw, unchecked."""
    return (rotation.x, rotation.y, rotation.z, rotation.w)


def to_quaternion_message(rotation: Quaternion) -> QuaternionMessage:
    """A message from xyzw."""
    x, y, z, w = rotation
    return QuaternionMessage(x=x, y=y, z=z, w=w)


def edge_from_message(message: RelativeRotation, default_robot: str, body_from_sensor: Quaternion) -> EdgeMeasurement:
    """An edge between bodies from one between sensors.

    Args:
        message: the measurement in the frame of a sensor that is fixed to the body.
        default_robot: stands for an empty robot name.
        body_from_sensor: orientation of the sensor in the body frame.

    Raises:
        RejectedInputError: a field that cannot be read at all.
    """
    return EdgeMeasurement(
        edge_id=message.id,
        source=_reference(message.source, default_robot),
        target=_reference(message.target, default_robot),
        target_from_source=target_from_source(to_tuple(message.rotation), body_from_sensor),
        kind=message.kind,
        precision=message.precision,
    )


def target_from_source(source_from_target: Quaternion, body_from_sensor: Quaternion) -> Quaternion:
    """The inside direction, between bodies, of a border rotation between sensors.

    Raises:
        RejectedInputError: not a rotation.
    """
    inverted = quaternion.inverse(checked_rotation(source_from_target))
    if body_from_sensor == quaternion.IDENTITY:
        return inverted
    sensor_from_body = quaternion.inverse(body_from_sensor)
    return quaternion.multiply(quaternion.multiply(body_from_sensor, inverted), sensor_from_body)


def orientations_message(answer: Answer, frame_id: str) -> AbsoluteOrientations:
    """The answer's keyframes."""
    return AbsoluteOrientations(
        header=_header(answer, frame_id),
        robots=list(answer.robots),
        keyframe_robots=_array("I", answer.keyframe_robot, np.uint32),
        keyframe_ids=_array("Q", answer.keyframe_id, np.uint64),
        stamps_ns=_array("q", answer.stamp_ns, np.int64),
        orientations=_array("d", answer.world_from_body, np.float64),
        components=_array("I", answer.component, np.uint32),
        uncertainties_deg=_array("f", np.degrees(answer.uncertainty), np.float32),
    )


def flags_message(answer: Answer, frame_id: str) -> OutlierFlags:
    """The answer's edges."""
    return OutlierFlags(
        header=_header(answer, frame_id),
        edge_ids=_array("Q", answer.edge_id, np.uint64),
        robots=list(answer.robots),
        source_robots=_array("I", answer.keyframe_robot[answer.source], np.uint32),
        source_ids=_array("Q", answer.keyframe_id[answer.source], np.uint64),
        target_robots=_array("I", answer.keyframe_robot[answer.target], np.uint32),
        target_ids=_array("Q", answer.keyframe_id[answer.target], np.uint64),
        kinds=_array("B", answer.kind, np.uint8),
        scores=_array("f", answer.outlier_score, np.float32),
        outliers=answer.outlier.tolist(),
    )


def _header(answer: Answer, frame_id: str) -> Header:
    newest = int(answer.stamp_ns.max()) if len(answer.stamp_ns) else 0
    return Header(stamp=to_time(newest), frame_id=frame_id)


def _reference(message: ReferenceMessage, default_robot: str) -> KeyframeReference:
    robot = message.robot or default_robot
    stamp_ns = to_nanoseconds(message.stamp)
    if message.by == ReferenceMessage.BY_ID:
        return KeyframeReference(robot, message.id, stamp_ns or None)
    if message.by == ReferenceMessage.BY_STAMP:
        return KeyframeReference(robot, None, stamp_ns)
    raise RejectedInputError(RejectReason.BAD_REFERENCE)


def _array(typecode: str, values: NDArray[Any], dtype: DTypeLike) -> array[Any]:
    """Flat, in the form that a message takes over without looking at every element."""
    flat = array(typecode)
    flat.frombytes(np.ascontiguousarray(values, dtype=dtype).tobytes())
    return flat
