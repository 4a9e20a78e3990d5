"""A program that speaks others' messages: a square, seen by RTAB-Map, Kimera, slam_toolbox and two of Swarm-SLAM.

A process of its own, because only it and the node it talks to see those messages. With the argument `rejected`
Kimera's back end has rejected its closure.
"""

from __future__ import annotations

import sys

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from cslam_common_interfaces.msg import InterRobotLoopClosure, IntraRobotLoopClosure, KeyframeOdom
from geometry_msgs.msg import Pose, Quaternion, Transform
from pose_graph_tools_msgs.msg import PoseGraph, PoseGraphEdge, PoseGraphNode
from rclpy.qos import QoSProfile
from rtabmap_msgs.msg import Link, MapGraph
from scipy.spatial.transform import Rotation
from slam_toolbox.msg import GraphEdge, GraphNode, NewNodeEvent
from slam_toolbox.msg import PoseGraph as NumberedGraph

SIDES = 4
BODY_FROM_SENSOR = Rotation.from_euler("zyx", [-90, 0, -90], degrees=True)  # a camera that looks ahead
KIMERA, SWARM = 1, (2, 3)  # places in the node's parameter `robots`


def world_from_body(corner: int, turned_deg: float = 0.0) -> Rotation:
    """Around a square, with a roll that makes the rotations not commute."""
    return Rotation.from_euler("zx", [turned_deg + 90 * corner, 20 * corner], degrees=True)


def quaternion(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def between(source: Rotation, target: Rotation) -> Quaternion:
    """Orientation of the target's sensor in the source's."""
    return quaternion((source * BODY_FROM_SENSOR).inv() * target * BODY_FROM_SENSOR)


def diagonal(value: float) -> list[float]:
    return np.diag([value] * 6).ravel().tolist()


def stamp(corner: int) -> Time:
    return Time(sec=100 + corner)


def map_graph() -> MapGraph:
    def link(source: int, target: int, kind: int) -> Link:
        rotation = between(world_from_body(source), world_from_body(target))
        return Link(
            from_id=source + 1,
            to_id=target + 1,
            type=kind,
            transform=Transform(rotation=rotation),
            information=diagonal(1e4),
        )

    graph = MapGraph(poses_id=list(range(1, SIDES + 1)), poses=[Pose()] * SIDES)
    graph.header.stamp = stamp(SIDES - 1)
    graph.links = [link(3, 0, 1), *(link(corner, corner + 1, 0) for corner in range(SIDES - 1)), link(0, 0, 9)]
    return graph


def pose_graph(closure: int) -> PoseGraph:
    def edge(source: int, target: int, kind: int) -> PoseGraphEdge:
        pose = Pose(orientation=between(world_from_body(source), world_from_body(target)))
        ends = {"key_from": source, "key_to": target, "robot_from": KIMERA, "robot_to": KIMERA}
        return PoseGraphEdge(**ends, type=kind, pose=pose, covariance=diagonal(1e-4))

    nodes = [PoseGraphNode(robot_id=KIMERA, key=corner) for corner in range(SIDES)]
    for corner, node in enumerate(nodes):
        node.header.stamp = stamp(corner)
    steps = [edge(corner, corner + 1, PoseGraphEdge.ODOM) for corner in range(SIDES - 1)]
    return PoseGraph(nodes=nodes, edges=[edge(3, 0, closure), *steps])


def numbered_edge(source: int, target: int) -> GraphEdge:
    pose = Pose(orientation=between(world_from_body(source), world_from_body(target)))
    covariance = np.diag([1e-2, 1e-2, 1e-4]).ravel().tolist()
    return GraphEdge(source_id=source, target_id=target, relative_pose=pose, covariance=covariance)


def numbered_graph() -> NumberedGraph:
    """Published long after its last node."""
    graph = NumberedGraph(nodes=[GraphNode(node_id=corner) for corner in range(SIDES)])
    graph.header.stamp, graph.header.frame_id = stamp(50), "map"
    graph.edges = [numbered_edge(3, 0), *(numbered_edge(corner, corner + 1) for corner in range(SIDES - 1))]
    return graph


def new_node(corner: int) -> NewNodeEvent:
    """The first node has no edge, so its event's is as it was made."""
    edge = numbered_edge(corner - 1, corner) if corner else GraphEdge()
    return NewNodeEvent(new_node_id=corner, stamp=stamp(corner), edge=edge)


def keyframe(corner: int, turned_deg: float) -> KeyframeOdom:
    message = KeyframeOdom(id=corner)
    message.odom.header.stamp = stamp(corner)
    message.odom.pose.pose.orientation = quaternion(world_from_body(corner, turned_deg) * BODY_FROM_SENSOR)
    return message


def intra_closure() -> IntraRobotLoopClosure:
    transform = Transform(rotation=between(world_from_body(3), world_from_body(0)))
    return IntraRobotLoopClosure(keyframe0_id=3, keyframe1_id=0, success=True, transform=transform)


def inter_closure() -> InterRobotLoopClosure:
    """The first robot's keyframe 1 sees the second one's keyframe 2, which is turned by another 30°."""
    message = InterRobotLoopClosure(robot0_id=SWARM[0], robot0_keyframe_id=1, success=True)
    message.robot1_id, message.robot1_keyframe_id = SWARM[1], 2
    message.transform = Transform(rotation=between(world_from_body(1), world_from_body(2, 30)))
    return message


def main() -> None:
    rejected = "rejected" in sys.argv
    rclpy.init()
    node = rclpy.create_node("foreign")
    qos = QoSProfile(depth=100)
    topics = {
        "map_graph": (MapGraph, [map_graph()]),
        "pose_graph": (PoseGraph, [pose_graph(3 if rejected else 1)]),
        "slam/pose_graph": (NumberedGraph, [numbered_graph()]),
        "slam/new_node_event": (NewNodeEvent, [new_node(corner) for corner in range(SIDES)]),
        # Each robot's odometry begins with an orientation of its own.
        "r2/keyframe_odom": (KeyframeOdom, [keyframe(corner, 0) for corner in range(SIDES)]),
        "r3/keyframe_odom": (KeyframeOdom, [keyframe(corner, 71) for corner in range(SIDES)]),
        "r2/intra": (IntraRobotLoopClosure, [intra_closure(), IntraRobotLoopClosure(success=False)]),
        "inter": (InterRobotLoopClosure, [inter_closure()]),
    }
    publishers = {topic: node.create_publisher(kind, topic, qos) for topic, (kind, _) in topics.items()}
    while not all(publisher.get_subscription_count() for publisher in publishers.values()):
        rclpy.spin_once(node, timeout_sec=0.05)
    rclpy.spin_once(node, timeout_sec=1.0)  # the other side has found this one as well
    while True:  # everything again and again, as such systems do; the test ends the process
        for topic, publisher in publishers.items():
            for message in topics[topic][1]:
                publisher.publish(message)
        rclpy.spin_once(node, timeout_sec=0.3)


if __name__ == "__main__":
    main()
