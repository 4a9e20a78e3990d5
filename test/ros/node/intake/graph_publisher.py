"""A program that publishes whole graphs with three false closures, and prints which edges come back.

A process of its own, because only it and the node it talks to see others' messages.
"""

from __future__ import annotations

import json

import numpy as np
import rclpy
from geometry_msgs.msg import Pose, Quaternion, Transform
from pose_graph_tools_msgs.msg import PoseGraph, PoseGraphEdge, PoseGraphNode
from rclpy.qos import QoSProfile
from rtabmap_msgs.msg import Link, MapGraph
from scipy.spatial.transform import Rotation

LENGTH, KIMERA = 41, 1
FALSE = {(3, 20): 1.0, (9, 33): -1.3, (14, 38): 2.2}
TRUE = [(each, each + 17) for each in range(2, 24, 2)]


def edges() -> list[tuple[int, int, Quaternion]]:
    turns = [Rotation.from_rotvec([0.1, 0, 0.2 * each]) for each in range(LENGTH)]
    found = []
    for source, target in [*((each, each + 1) for each in range(LENGTH - 1)), *TRUE, *FALSE]:
        off = Rotation.from_rotvec([0, FALSE.get((source, target), 0.0), 0])
        x, y, z, w = (turns[source].inv() * turns[target] * off).as_quat().tolist()
        found.append((source, target, Quaternion(x=x, y=y, z=z, w=w)))
    return found


def main() -> None:
    rclpy.init()
    node = rclpy.create_node("foreign")
    qos = QoSProfile(depth=100)
    information = np.diag([1e4] * 6).ravel().tolist()
    graph = MapGraph(poses_id=list(range(LENGTH)), poses=[Pose()] * LENGTH)
    graph.header.stamp.sec = 100
    kimera = PoseGraph(nodes=[PoseGraphNode(robot_id=KIMERA, key=each) for each in range(LENGTH)])
    for source, target, rotation in edges():
        is_step = target == source + 1
        link = Link(from_id=source, to_id=target, type=0 if is_step else 1, information=information)
        link.transform = Transform(rotation=rotation)
        graph.links.append(link)
        edge = PoseGraphEdge(key_from=source, key_to=target, robot_from=KIMERA, robot_to=KIMERA)
        edge.type, edge.pose = 0 if is_step else 1, Pose(orientation=rotation)
        kimera.edges.append(edge)

    def on_graph(message: MapGraph) -> None:
        print(json.dumps({"graph": [[each.from_id, each.to_id] for each in message.links]}), flush=True)
        print(json.dumps({"nodes": [[len(message.poses_id), len(message.poses)]]}), flush=True)

    def on_kimera(message: PoseGraph) -> None:
        print(json.dumps({"kimera": [[each.key_from, each.key_to] for each in message.edges]}), flush=True)

    node.create_subscription(MapGraph, "trusted_graph", on_graph, qos)
    node.create_subscription(PoseGraph, "trusted_kimera", on_kimera, qos)
    publishers = [(node.create_publisher(MapGraph, "graph", qos), graph)]
    publishers += [(node.create_publisher(PoseGraph, "kimera", qos), kimera)]
    while True:  # everything again and again, as such systems do; the test ends the process
        for publisher, message in publishers:
            publisher.publish(message)
        rclpy.spin_once(node, timeout_sec=0.5)


if __name__ == "__main__":
    main()
