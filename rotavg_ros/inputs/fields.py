"""Fields of ROS messages as plain numbers, and the only place where the direction of edges is inverted.

A message carries an edge as the orientation of the target in the source frame (source_from_target). Internally, an edge
is target_from_source.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Sequence
from typing import Any

from rotavg_ros.online import RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError, checked_rotation
from rotavg_ros.online.quaternion import Quaternion, Vector
from rotavg_ros.stamps import NANOSECONDS

# (robot, keyframe id)
Key = tuple[str, int]

# The diagonal of the rotation's block in a row-major 6 × 6 matrix over (x, y, z, rotation about x, about y, about z).
_ROTATION_DIAGONAL = (21, 28, 35)


def to_nanoseconds(stamp: Any) -> int:
    """Nanoseconds of a ``builtin_interfaces/Time``.

    Raises:
        RejectedInputError: the fraction is a second or more, or the stamp lies before 1970.
    """
    nanosec: int = stamp.nanosec
    seconds: int = stamp.sec
    if nanosec >= NANOSECONDS or seconds < 0:
        raise RejectedInputError(RejectReason.BAD_STAMP)
    return seconds * NANOSECONDS + nanosec


def to_tuple(rotation: Any) -> Quaternion:
    """The four numbers xyzw of a ``geometry_msgs/Quaternion``, unchecked."""
    return (rotation.x, rotation.y, rotation.z, rotation.w)


def to_vector(vector: Any) -> Vector:
    """The three numbers of a ``geometry_msgs/Vector3`` or ``Point``."""
    return (vector.x, vector.y, vector.z)


def target_from_source(source_from_target: Quaternion, body_from_sensor: Quaternion) -> Quaternion:
    """The internal rotation, between bodies, from a message's rotation between sensors.

    Raises:
        RejectedInputError: not a rotation.
    """
    inverted = quaternion.inverse(checked_rotation(source_from_target))
    if body_from_sensor == quaternion.IDENTITY:
        return inverted
    sensor_from_body = quaternion.inverse(body_from_sensor)
    return quaternion.multiply(quaternion.multiply(body_from_sensor, inverted), sensor_from_body)


def precision_of_information(information: Sequence[float]) -> float:
    """Rad⁻²: the mean of the rotation's diagonal in a 6 × 6 information matrix, as in g2o files; 0 unknown."""
    return sum(float(information[index]) for index in _ROTATION_DIAGONAL) / 3


def precision_of_covariance(covariance: Sequence[float]) -> float:
    """Rad⁻²: the inverse of the mean variance of the rotation in a 6 × 6 covariance matrix; 0 unknown.

    Senders that do not know the variance write zero or NaN. A negative sum stays negative, so that it is refused.
    """
    total = sum(float(covariance[index]) for index in _ROTATION_DIAGONAL)
    return 3 / total if total and not math.isnan(total) else 0.0


def edge_id_of(source: Key, target: Key, kind: int) -> int:
    """An id for an edge whose sender gives none, the same in every run.

    Within a robot: kind (1 bit), source's id (31 bits), target's id (32 bits). Where ids are larger, as gtsam's symbols
    are, and between robots, which it tells apart: kind, and a hash of both ends (63 bits).
    """
    (source_robot, source_id), (target_robot, target_id) = source, target
    if source_robot == target_robot and 0 <= source_id < 2**31 and 0 <= target_id < 2**32:
        return kind << 63 | source_id << 32 | target_id
    digest = hashlib.blake2b(ascii((source, target)).encode(), digest_size=8).digest()
    return kind << 63 | int.from_bytes(digest, "little") >> 1
