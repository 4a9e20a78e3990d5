"""Odometry from all message types that state the body's orientation at a stamp."""

from __future__ import annotations

from typing import Any

from rotavg_ros.inputs.fields import to_nanoseconds, to_tuple
from rotavg_ros.inputs.records import OdometryRecord
from rotavg_ros.online import RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion


def from_odometry(message: Any, body_from_sensor: Quaternion) -> OdometryRecord:
    """``nav_msgs/Odometry``."""
    return _record(message.header, message.pose.pose, body_from_sensor, message.child_frame_id)


def from_pose_with_covariance(message: Any, body_from_sensor: Quaternion) -> OdometryRecord:
    """``geometry_msgs/PoseWithCovarianceStamped``."""
    return _record(message.header, message.pose.pose, body_from_sensor)


def from_pose(message: Any, body_from_sensor: Quaternion) -> OdometryRecord:
    """``geometry_msgs/PoseStamped``."""
    return _record(message.header, message.pose, body_from_sensor)


def from_imu(message: Any, body_from_sensor: Quaternion) -> OdometryRecord:
    """``sensor_msgs/Imu``; a first covariance of -1 says that the device estimates no orientation.

    Raises:
        RejectedInputError: no orientation, or no stamp.
    """
    if message.orientation_covariance[0] == -1:
        raise RejectedInputError(RejectReason.NO_ORIENTATION)
    stamp_ns = to_nanoseconds(message.header.stamp)
    orientation = _world_from_body(message.orientation, body_from_sensor)
    return OdometryRecord(stamp_ns, orientation, None, child_frame_id=message.header.frame_id)


def _record(header: Any, pose: Any, body_from_sensor: Quaternion, child_frame_id: str = "") -> OdometryRecord:
    position = pose.position
    return OdometryRecord(
        to_nanoseconds(header.stamp),
        _world_from_body(pose.orientation, body_from_sensor),
        (position.x, position.y, position.z),
        header.frame_id,
        child_frame_id,
        body_from_sensor,
    )


def _world_from_body(world_from_sensor: Any, body_from_sensor: Quaternion) -> Quaternion:
    orientation = to_tuple(world_from_sensor)
    if body_from_sensor == quaternion.IDENTITY:
        return orientation
    return quaternion.multiply(orientation, quaternion.inverse(body_from_sensor))
