"""Others' messages into the node, over DDS: directions around a square, repetitions, verdicts, kinds of odometry."""

from __future__ import annotations

import itertools
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Quaternion, QuaternionStamped
from nav_msgs.msg import Odometry
from sensor_msgs.msg import Imu

pytestmark = pytest.mark.ros

PUBLISHER = Path(__file__).with_name("foreign_publisher.py")
NODE = Path(sys.executable).with_name("rotavg_node")
BODY_FROM_SENSOR = Rotation.from_euler("zyx", [-90, 0, -90], degrees=True)
CAMERA = str(BODY_FROM_SENSOR.as_quat().tolist())
ROBOTS = ["rtabmap", "kimera", "swarm2", "swarm3", "slam"]
MAP_GRAPH = "map_graph:rtabmap_msgs/msg/MapGraph"
EDGE_TOPICS = {
    MAP_GRAPH: "rtabmap",
    "pose_graph:pose_graph_tools_msgs/msg/PoseGraph": "",
    "r2/keyframe_odom:cslam_common_interfaces/msg/KeyframeOdom": "swarm2",
    "r3/keyframe_odom:cslam_common_interfaces/msg/KeyframeOdom": "swarm3",
    "r2/intra:cslam_common_interfaces/msg/IntraRobotLoopClosure": "swarm2",
    "inter:cslam_common_interfaces/msg/InterRobotLoopClosure": "",
    "slam/pose_graph:slam_toolbox/msg/PoseGraph": "slam",
    "slam/new_node_event:slam_toolbox/msg/NewNodeEvent": "slam",
}


def strings(values) -> str:
    return "[" + ", ".join(f"'{value}'" for value in values) + "]"


def world_from_body(corner: int, turned_deg: float = 0.0) -> Rotation:
    return Rotation.from_euler("zx", [turned_deg + 90 * corner, 20 * corner], degrees=True)


def by_robot(answer, robot: str) -> dict[int, Rotation]:
    """world_from_body of a robot's keyframes by id."""
    orientations = np.asarray(answer.orientations).reshape(-1, 4)
    index = list(answer.robots).index(robot)
    return {
        int(number): Rotation.from_quat(orientations[k])
        for k, (owner, number) in enumerate(zip(answer.keyframe_robots, answer.keyframe_ids, strict=True))
        if owner == index
    }


def test_graphs_of_other_systems(foreign_packages, live_node, start_process) -> None:
    words = [
        f"odometry_topics:={strings(f'{robot}/odom' for robot in ROBOTS)}",
        f"robots:={strings(ROBOTS)}",
        f"edge_topics:={strings(EDGE_TOPICS)}",
        f"edge_robots:={strings(EDGE_TOPICS.values())}",
        f"edge_sensor_orientations:={CAMERA}",
        "keyframe_source:=edges",
        "solve_period_s:=0.1",
    ]
    live_node.process = start_process(NODE, "--ros-args", *(part for word in words for part in ("-p", word)))
    speaker = start_process(sys.executable, PUBLISHER)
    live_node.spin_until(lambda: bool(live_node.answers) and len(live_node.answers[-1].keyframe_ids) == 20)
    live_node.spin_until(lambda: len(set(live_node.answers[-1].components)) == 4)  # the two of Swarm-SLAM are joined
    # What slam_toolbox says on both of its topics, its 3 steps, is known when it comes the second time.
    live_node.spin_until(lambda: live_node.status.get("dropped duplicate_edge") == "3")
    answer = live_node.wait_for_silence()
    squares = {robot: by_robot(answer, robot) for robot in ROBOTS}
    assert sorted(squares["rtabmap"]) == [1, 2, 3, 4]
    corners = {
        (robot, number - (robot == "rtabmap")): turned for robot in ROBOTS for number, turned in squares[robot].items()
    }
    for robot in ROBOTS:
        for corner in range(4):
            expected = world_from_body(0).inv() * world_from_body(corner)
            if robot == "swarm3":  # KeyframeOdom is cumulative in a frame of the robot's own
                expected = world_from_body(0, 71).inv() * world_from_body(corner, 71)
            found = corners[robot, 0].inv() * corners[robot, corner]
            assert np.degrees((expected.inv() * found).magnitude()) < 0.01, (robot, corner)
    found = corners["swarm2", 1].inv() * corners["swarm3", 2]
    expected = world_from_body(1).inv() * world_from_body(2, 30)
    assert np.degrees((expected.inv() * found).magnitude()) < 0.01
    # Everything came many times by now, and came in once: 4 edges of each graph, 3 + 3 steps, 2 closures.
    assert live_node.status["dropped duplicate_edge"] == "3"
    assert live_node.status["edges"] == "20" and live_node.status["dropped out_of_order_odometry"] != "0"
    assert not any(live_node.flags[-1].outliers)
    stamps = dict(zip(zip(answer.keyframe_robots, answer.keyframe_ids, strict=True), answer.stamps_ns, strict=True))
    robots = list(answer.robots)
    assert stamps[robots.index("rtabmap"), 4] == 103 * 10**9 and stamps[robots.index("rtabmap"), 1] == -1
    assert stamps[robots.index("kimera"), 2] == 102 * 10**9
    assert [stamps[robots.index("slam"), corner] for corner in range(4)] == [k * 10**9 for k in range(100, 104)]

    speaker.stop()
    speaker = start_process(sys.executable, PUBLISHER, "rejected")  # Kimera's back end has changed its mind
    live_node.spin_until(lambda: sum(live_node.flags[-1].outliers) == 1)
    rejected = list(live_node.flags[-1].outliers).index(True)
    assert live_node.flags[-1].robots[live_node.flags[-1].source_robots[rejected]] == "kimera"
    assert live_node.status["edges"] == "20"

    # What is repeated is news again. Nobody speaks meanwhile: a reset in the midst of a robot's keyframes would take
    # the later ones for the first, and refuse the earlier ones when they come again.
    speaker.stop()
    live_node.wait_for_silence()
    assert live_node.call("reset").success
    seen = len(live_node.answers)
    speaker = start_process(sys.executable, PUBLISHER)
    live_node.spin_until(lambda: len(live_node.answers) > seen and len(live_node.answers[-1].keyframe_ids) == 20)
    speaker.stop()


def test_a_package_that_is_not_installed_is_one_line() -> None:
    words = ["-p", f"edge_topics:=['{MAP_GRAPH}']", "-p", "keyframe_source:=edges"]
    ended = subprocess.run([NODE, "--ros-args", *words], capture_output=True, text=True, timeout=300, check=False)
    assert ended.returncode == 2
    assert "install the package rtabmap_msgs" in ended.stderr and len(ended.stderr.splitlines()) == 1


def test_every_kind_of_odometry(live_node, start_process, probe_node) -> None:
    """Four robots on the same curve, told of by different messages about a camera that is turned in the body."""
    kinds = {"odom": Odometry, "pose_cov": PoseWithCovarianceStamped, "pose": PoseStamped, "imu": Imu}
    types = {name: f"{kind.__module__.split('.')[0]}/msg/{kind.__name__}" for name, kind in kinds.items()}
    words = [
        f"odometry_topics:={strings(f'{name}:{types[name]}' for name in kinds)}",
        f"robots:={strings(kinds)}",
        f"odometry_sensor_orientations:={CAMERA}",
        *(f"qos_overrides./{name}.subscription.reliability:=reliable" for name in kinds),
    ]
    publishers = {name: probe_node.create_publisher(kind, name, 100) for name, kind in kinds.items()}
    heard: dict[str, list[QuaternionStamped]] = {name: [] for name in kinds}
    for name in kinds:
        probe_node.create_subscription(QuaternionStamped, f"{name}/orientation", heard[name].append, 100)
    live_node.process = start_process(NODE, "--ros-args", *(part for word in words for part in ("-p", word)))
    live_node.spin_until(lambda: all(publisher.get_subscription_count() for publisher in publishers.values()))
    live_node.spin_until(lambda: all(probe_node.count_publishers(f"/{name}/orientation") for name in kinds))

    def truth(index: int) -> Rotation:
        return Rotation.from_euler("zx", [8 * index, 10], degrees=True)

    def publish(second: int, index: int) -> None:
        x, y, z, w = (truth(index) * BODY_FROM_SENSOR).as_quat().tolist()
        for name, publisher in publishers.items():
            message = kinds[name]()
            message.header.stamp = Time(sec=second, nanosec=index * 40_000_000)
            holder = {"odom": lambda m: m.pose.pose, "pose_cov": lambda m: m.pose.pose, "pose": lambda m: m.pose}
            target = holder.get(name, lambda m: m)(message)
            target.orientation = Quaternion(x=x, y=y, z=z, w=w)
            publisher.publish(message)

    # The node may not have found who listens yet, though that is here already: it says nothing twice to latecomers.
    early = itertools.count()

    def all_are_heard() -> bool:
        publish(40 + next(early), 0)
        live_node.spin_for(0.1)
        return all(heard.values())

    live_node.spin_until(all_are_heard)
    last = 40 + next(early)
    for index in range(20):
        publish(last, index)

    def told() -> bool:
        return all(sum(message.header.stamp.sec == last for message in messages) == 20 for messages in heard.values())

    live_node.spin_until(told)
    for messages in heard.values():
        q = messages[-1].quaternion
        between = Rotation.from_quat([q.x, q.y, q.z, q.w]).inv() * truth(19)
        assert np.degrees(between.magnitude()) < 1e-6
    silent = Imu()
    silent.header.stamp, silent.orientation_covariance[0] = Time(sec=last + 1), -1.0
    publishers["imu"].publish(silent)
    live_node.spin_until(lambda: live_node.status.get("dropped no_orientation") == "1")
