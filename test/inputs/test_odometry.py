"""Orientations and positions out of messages of odometry."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import ODOMETRY_CONVERTERS
from rotavg_ros.inputs.fields import to_nanoseconds
from rotavg_ros.online.measurements import RejectedInputError

from .square import (
    BODY_FROM_SENSOR,
    pose,
    position,
    quaternion,
    stamp,
    vector,
    world_from_body,
    world_from_sensor,
)


@pytest.mark.parametrize("type_name", ODOMETRY_CONVERTERS)
def test_odometry_of_a_sensor_that_is_turned_in_the_body(type_name: str) -> None:
    orientation = quaternion(world_from_sensor(2))
    here = pose(orientation, vector(position(2)))
    posed = {
        "nav_msgs/msg/Odometry": Fields(pose=here),
        "geometry_msgs/msg/PoseWithCovarianceStamped": Fields(pose=here),
        "geometry_msgs/msg/PoseStamped": here,
    }
    message = Fields(header=Fields(stamp=stamp(2), frame_id="odom"), child_frame_id="base")
    if type_name in posed:
        message.pose = posed[type_name]
    else:
        message.orientation, message.orientation_covariance = orientation, np.zeros(9)
    record = ODOMETRY_CONVERTERS[type_name](message, tuple(BODY_FROM_SENSOR.as_quat().tolist()))
    assert record.stamp_ns == to_nanoseconds(stamp(2))
    assert (Rotation.from_quat(record.world_from_body).inv() * world_from_body(2)).magnitude() < 1e-12
    assert record.position == (tuple(position(2).tolist()) if type_name in posed else None)


def test_an_imu_without_orientation() -> None:
    message = Fields(header=Fields(stamp=stamp(0), frame_id="imu"), orientation=quaternion(Rotation.identity()))
    message.orientation_covariance = np.array([-1.0] + [0.0] * 8)
    with pytest.raises(RejectedInputError, match="no_orientation"):
        ODOMETRY_CONVERTERS["sensor_msgs/msg/Imu"](message, (0.0, 0.0, 0.0, 1.0))
