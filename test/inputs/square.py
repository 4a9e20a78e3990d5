"""Messages of a robot that drives around a square, as bare objects with their fields."""

from __future__ import annotations

from types import SimpleNamespace as Fields

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.inputs import EDGE_CONVERTERS, EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement

SIDES = 4
BODY_FROM_SENSOR = Rotation.from_euler("zyx", [-90, 0, -90], degrees=True)  # a camera that looks ahead


def world_from_body(corner: int) -> Rotation:
    """Around a square, with a roll that makes the rotations not commute."""
    return Rotation.from_euler("zx", [90 * corner, 20 * (corner % SIDES)], degrees=True)


def world_from_sensor(corner: int) -> Rotation:
    return world_from_body(corner) * BODY_FROM_SENSOR


def position(corner: int) -> np.ndarray:
    return np.array([np.cos(np.pi / 2 * corner), np.sin(np.pi / 2 * corner), 0.1 * (corner % SIDES)])


def vector(xyz: np.ndarray) -> Fields:
    x, y, z = xyz.tolist()
    return Fields(x=x, y=y, z=z)


def quaternion(rotation: Rotation) -> Fields:
    x, y, z, w = rotation.as_quat().tolist()
    return Fields(x=x, y=y, z=z, w=w)


def between(source: int, target: int) -> Fields:
    """Orientation of the target in the source frame, as gtsam's BetweenFactor has it."""
    return quaternion(world_from_sensor(source).inv() * world_from_sensor(target))


def way(source: int, target: int) -> Fields:
    """Position of the target in the source frame."""
    return vector(world_from_sensor(source).inv().apply(position(target) - position(source)))


def transform(source: int, target: int) -> Fields:
    return Fields(rotation=between(source, target), translation=way(source, target))


def stamp(corner: int) -> Fields:
    return Fields(sec=100 + corner, nanosec=5)


def pose(rotation: Fields, xyz: Fields) -> Fields:
    return Fields(position=xyz, orientation=rotation)


def diagonal(rotation: float) -> np.ndarray:
    return np.diag([9.0, 9.0, 9.0, rotation, rotation, rotation]).ravel()


def link(source: int, target: int, kind: int) -> Fields:
    pose_between = transform(source, target)
    return Fields(from_id=source, to_id=target, type=kind, transform=pose_between, information=diagonal(25.0))


def map_graph() -> Fields:
    links = [link(3, 0, 1), link(0, 1, 0), link(1, 2, 0), link(2, 3, 0), link(1, 3, 7), link(0, 0, 9)]
    return Fields(header=Fields(stamp=stamp(3)), poses_id=np.arange(4, dtype=np.int32), links=links)


def pose_graph_edge(source: int, target: int, kind: int) -> Fields:
    return Fields(
        key_from=source,
        key_to=target,
        robot_from=1,
        robot_to=1,
        type=kind,
        pose=pose(between(source, target), way(source, target)),
        covariance=diagonal(0.04),
    )


def pose_graph(closure: int) -> Fields:
    nodes = [Fields(robot_id=1, key=key, header=Fields(stamp=stamp(key))) for key in range(SIDES)]
    edges = [pose_graph_edge(3, 0, closure), *(pose_graph_edge(key, key + 1, 0) for key in range(3))]
    return Fields(nodes=nodes, edges=edges)


def numbered_edge(source: int, target: int) -> Fields:
    """Of slam_toolbox as it is since Pose2D is deprecated."""
    relative_pose = pose(between(source, target), way(source, target))
    covariance = np.diag([9.0, 9.0, 0.04]).ravel()
    return Fields(source_id=source, target_id=target, relative_pose=relative_pose, covariance=covariance)


def numbered_graph() -> Fields:
    """Stamped when it is published, long after its last node."""
    nodes = [Fields(node_id=corner) for corner in range(SIDES)]
    edges = [numbered_edge(3, 0), *(numbered_edge(corner, corner + 1) for corner in range(3))]
    return Fields(header=Fields(stamp=stamp(50), frame_id="map"), nodes=nodes, edges=edges)


def new_node(corner: int) -> Fields:
    """The first node's event has an edge that nobody has filled in."""
    return Fields(new_node_id=corner, stamp=stamp(corner), edge=numbered_edge(max(corner - 1, 0), corner))


def keyframe_odometry(corner: int) -> Fields:
    here = pose(quaternion(world_from_sensor(corner)), vector(position(corner)))
    odometry = Fields(header=Fields(stamp=stamp(corner)), pose=Fields(pose=here))
    return Fields(id=corner, odom=odometry)


def intra_closure(success: bool = True) -> Fields:
    return Fields(keyframe0_id=3, keyframe1_id=0, success=success, transform=transform(3, 0))


def inter_closure() -> Fields:
    ends = {"robot0_id": 1, "robot0_keyframe_id": 3, "robot1_id": 2, "robot1_keyframe_id": 0}
    return Fields(**ends, success=True, transform=transform(3, 0))


def converter(type_name: str):
    return EDGE_CONVERTERS[type_name](Source("b", ("a", "b", "c"), tuple(BODY_FROM_SENSOR.as_quat().tolist())))


def edges(records) -> list[EdgeMeasurement]:
    return [record.edge for record in records if isinstance(record, EdgeRecord)]


SQUARE = {
    "rtabmap_msgs/msg/MapGraph": ([map_graph()], 25.0),
    "pose_graph_tools_msgs/msg/PoseGraph": ([pose_graph(1)], 25.0),
    "slam_toolbox/msg/PoseGraph": ([numbered_graph()], 25.0),
    "slam_toolbox/msg/NewNodeEvent": ([new_node(corner) for corner in range(SIDES)], 25.0),
    "cslam_common_interfaces/msg/KeyframeOdom": ([keyframe_odometry(corner) for corner in range(SIDES)], 0.0),
    "cslam_common_interfaces/msg/IntraRobotLoopClosure": ([intra_closure()], 0.0),
    "cslam_common_interfaces/msg/InterRobotLoopClosure": ([inter_closure()], 0.0),
}
