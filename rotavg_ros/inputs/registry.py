"""Converters by type name."""

from __future__ import annotations

from collections.abc import Callable

from rotavg_ros.inputs.cslam import (
    InterRobotLoopClosureConverter,
    IntraRobotLoopClosureConverter,
    KeyframeOdomConverter,
)
from rotavg_ros.inputs.odometry import from_imu, from_odometry, from_pose, from_pose_with_covariance
from rotavg_ros.inputs.pose_graph_tools import PoseGraphConverter
from rotavg_ros.inputs.records import EdgeConverter, OdometryConverter, Source
from rotavg_ros.inputs.rotavg import RelativeRotationArrayConverter, RelativeRotationConverter
from rotavg_ros.inputs.rtabmap import MapGraphConverter
from rotavg_ros.inputs.slam_toolbox import GraphConverter, NewNodeConverter

_FOREIGN: dict[str, Callable[[Source], EdgeConverter]] = {
    "rtabmap_msgs/msg/MapGraph": MapGraphConverter,
    "pose_graph_tools_msgs/msg/PoseGraph": PoseGraphConverter,
    "slam_toolbox/msg/PoseGraph": GraphConverter,
    "slam_toolbox/msg/NewNodeEvent": NewNodeConverter,
    "cslam_common_interfaces/msg/KeyframeOdom": KeyframeOdomConverter,
    "cslam_common_interfaces/msg/IntraRobotLoopClosure": IntraRobotLoopClosureConverter,
    "cslam_common_interfaces/msg/InterRobotLoopClosure": InterRobotLoopClosureConverter,
}

# Types that carry edges; each topic gets a converter of its own.
EDGE_CONVERTERS: dict[str, Callable[[Source], EdgeConverter]] = {
    "rotavg_msgs/msg/RelativeRotation": RelativeRotationConverter,
    "rotavg_msgs/msg/RelativeRotationArray": RelativeRotationArrayConverter,
    **_FOREIGN,
}

# Types with edges between keyframes that the sender has chosen and numbered, so that none may be made from odometry.
BRINGS_KEYFRAMES = frozenset(_FOREIGN)

# Of these, types with keyframes of a robot that no message names.
OF_ONE_ROBOT = BRINGS_KEYFRAMES - {
    "pose_graph_tools_msgs/msg/PoseGraph",
    "cslam_common_interfaces/msg/InterRobotLoopClosure",
}

# Types that carry keyframes and the steps between them, but no closures.
WITHOUT_CLOSURES = frozenset({"slam_toolbox/msg/NewNodeEvent", "cslam_common_interfaces/msg/KeyframeOdom"})

# Its frame_id is the frame attached to the body; it does not name the frame in which the body turns.
FRAMELESS_ODOMETRY = "sensor_msgs/msg/Imu"

# Odometry whose messages may name the frame whose motion they describe.
NAMES_ITS_BODY = frozenset({"nav_msgs/msg/Odometry", FRAMELESS_ODOMETRY})

# Types that carry the rotation of a robot's odometry.
ODOMETRY_CONVERTERS: dict[str, OdometryConverter] = {
    "nav_msgs/msg/Odometry": from_odometry,
    "geometry_msgs/msg/PoseWithCovarianceStamped": from_pose_with_covariance,
    "geometry_msgs/msg/PoseStamped": from_pose,
    FRAMELESS_ODOMETRY: from_imu,
}
