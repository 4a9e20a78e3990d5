"""Three robots in one building: each has a node of its own, and one more node listens to all of them.

    python examples/three_robots.py

Eight processes on this machine: three robots that drive, their three nodes in the namespaces /a, /b and /c, the node
/fleet, and this one, which looks on. Half-way the robots begin to recognise each other's places, a fifth of the time
wrongly, and the fleet's three components become one. See docs/multi-robot.md for the same over several machines.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
import time
from collections.abc import Callable, Iterable

import numpy as np
import rclpy
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations, KeyframeReference, RelativeRotation
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, SlamSimulationConfig, simulate_slam_graph

ROBOTS = ("a", "b", "c")
POSES = 200  # of each robot
RENDEZVOUS = POSES // 2
PERIOD_NS = 200_000_000
START_NS = 1_000_000_000_000
SPEED_UP = 8
INTER_ROBOT = "/closures_between_robots"
KEEP_ALL = QoSProfile(depth=10_000)
LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
PATIENCE_S = 240.0
SETTLE_S = 2.0  # a subscription that this side has found has not always found this side yet, and would miss the start


def drive() -> SimulatedRun:
    """Three laps by one robot, which the three share: a lap each."""
    config = SlamSimulationConfig(
        num_keyframes=POSES * len(ROBOTS),
        laps=len(ROBOTS),
        dimensions=3,
        terrain_tilt_deg=5.0,
        closures_per_keyframe=0.5,
        false_share=0.2,
        odometry_noise_deg=0.7,
    )
    return simulate_slam_graph(config, np.random.default_rng(5))


def stamp_ns(pose: int) -> int:
    """When the robot that a pose belongs to was there: all of them set out at once."""
    return START_NS + pose % POSES * PERIOD_NS


# The robots


def be_robot(name: str) -> None:
    """Publish odometry from a frame of the robot's own, and closures as soon as both ends have been seen."""
    run, number = drive(), ROBOTS.index(name)
    first = number * POSES
    node = rclpy.create_node(f"robot_{name}")
    odometry = node.create_publisher(Odometry, f"/{name}/odom", KEEP_ALL)
    closures = {
        False: node.create_publisher(RelativeRotation, f"/{name}/relative_rotations", KEEP_ALL),
        True: node.create_publisher(RelativeRotation, INTER_ROBOT, KEEP_ALL),
    }
    fleet: list[AbsoluteOrientations] = []
    node.create_subscription(AbsoluteOrientations, "/fleet/abs_orientations", fleet.append, LATCHED)
    wait_until(node, lambda: all(each.get_subscription_count() > 1 for each in (odometry, closures[False])))
    wait_until(node, lambda: closures[True].get_subscription_count() > 0)
    time.sleep(SETTLE_S)
    due = closures_of(run, number)
    odom_from_body = Rotation.from_quat(run.odometry_world_from_body[first]).inv() * Rotation.from_quat(
        run.odometry_world_from_body
    )
    for pose in range(first, first + POSES):
        message = Odometry()
        message.header.stamp = to_time(stamp_ns(pose))
        message.header.frame_id = f"{name}/odom"
        message.pose.pose.orientation = to_message(odom_from_body[pose])
        x, y, z = (run.odometry_position[pose] - run.odometry_position[first]).tolist()
        message.pose.pose.position.x, message.pose.pose.position.y, message.pose.pose.position.z = x, y, z
        odometry.publish(message)
        for is_between, closure in due.get(pose - first, ()):
            closures[is_between].publish(closure)
        if pose - first == RENDEZVOUS - 1:  # nobody goes on before the fleet has heard of all
            wait_until(node, lambda: bool(fleet) and len(fleet[-1].robots) == len(ROBOTS))
        rclpy.spin_once(node, timeout_sec=0)
        time.sleep(1e-9 * PERIOD_NS / SPEED_UP)
    for publisher in (odometry, *closures.values()):
        publisher.wait_for_all_acked()


def closures_of(run: SimulatedRun, robot: int) -> dict[int, list[tuple[bool, RelativeRotation]]]:
    """Closures by the step of the robot at which it sends them; with others not before half-way."""
    due: dict[int, list[tuple[bool, RelativeRotation]]] = {}
    for edge in np.flatnonzero(~run.graph.is_odometry.numpy()).tolist():
        source, target = int(run.graph.source[edge]), int(run.graph.target[edge])
        owners = source // POSES, target // POSES
        if owners[1] != robot:
            continue
        is_between = owners[0] != owners[1]
        step = max(source % POSES, target % POSES, RENDEZVOUS if is_between else 0)
        x, y, z, w = run.graph.target_from_source[edge].tolist()
        closure = RelativeRotation(
            id=edge,
            source=reference(source),
            target=reference(target),
            rotation=Quaternion(x=-x, y=-y, z=-z, w=w),  # a message has the target in the source's frame
            precision=float(run.graph.precision[edge]),
            kind=RelativeRotation.LOOP_CLOSURE,
        )
        due.setdefault(step, []).append((is_between, closure))
    return due


def reference(pose: int) -> KeyframeReference:
    """The moment of a pose."""
    return KeyframeReference(by=KeyframeReference.BY_STAMP, robot=ROBOTS[pose // POSES], stamp=to_time(stamp_ns(pose)))


# The nodes


def node_command(namespace: str, robots: Iterable[str]) -> list[str]:
    """One of this package's nodes in a namespace, listening to some robots."""
    robots = list(robots)
    edge_topics = [f"/{robot}/relative_rotations" for robot in robots]
    if len(robots) > 1:
        edge_topics.append(INTER_ROBOT)
    parameters = {
        "robots": robots,
        "odometry_topics": [f"/{robot}/odom" for robot in robots],
        "edge_topics": edge_topics,
        "solver_threads": 1,
        "solve_period_s": 0.2,
        # Faster than real time, so nothing may get lost on the way.
        **{f"qos_overrides./{robot}/odom.subscription.reliability": "reliable" for robot in robots},
    }
    words = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    return [sys.executable, "-m", "rotavg_ros.ros.node.main", "--ros-args", "-r", f"__ns:=/{namespace}", *words]


# Looking on


class Onlooker:
    """Keeps every node's last answer, and says how many components the fleet's has."""

    def __init__(self, node: Node) -> None:
        self.answers: dict[str, AbsoluteOrientations] = {}
        self._last_news = time.monotonic()
        self._longest_silence = 0.0
        self._components = 0
        for name in (*ROBOTS, "fleet"):
            node.create_subscription(
                AbsoluteOrientations,
                f"/{name}/abs_orientations",
                lambda answer, name=name: self._note(name, answer),
                LATCHED,
            )

    def _note(self, name: str, answer: AbsoluteOrientations) -> None:
        if name in self.answers:
            self._longest_silence = max(self._longest_silence, time.monotonic() - self._last_news)
        self.answers[name], self._last_news = answer, time.monotonic()
        components = len(set(answer.components))
        if name == "fleet" and components != self._components:
            self._components = components
            print(f"fleet: {len(answer.keyframe_ids)} keyframes in {components} components", flush=True)

    def nothing_more_comes(self) -> bool:
        """Whether all have answered, and have been silent for longer than a loaded machine explains."""
        silence = time.monotonic() - self._last_news
        return len(self.answers) == len(ROBOTS) + 1 and silence > max(5.0, 3 * self._longest_silence)


def errors_deg(answer: AbsoluteOrientations, run: SimulatedRun) -> dict[str, float]:
    """Mean error of each robot's keyframes, all of them turned by one rotation onto the truth."""
    robots = np.array(answer.robots)[np.asarray(answer.keyframe_robots)]
    step = np.rint((np.asarray(answer.stamps_ns) - START_NS) / PERIOD_NS).astype(int)
    pose = np.array([ROBOTS.index(robot) for robot in robots]) * POSES + step
    truth = Rotation.from_quat(run.world_from_body[pose])
    estimate = Rotation.from_quat(np.asarray(answer.orientations).reshape(-1, 4))
    error = np.degrees((((truth * estimate.inv()).mean() * estimate).inv() * truth).magnitude())
    return {robot: float(error[robots == robot].mean()) for robot in ROBOTS if (robots == robot).any()}


def main() -> int:
    """Start everything, look on, report."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--robot", choices=ROBOTS, help="be one of the robots (started by the program itself)")
    arguments = parser.parse_args()
    rclpy.init()
    if arguments.robot:
        be_robot(arguments.robot)
        return 0
    node = rclpy.create_node("onlooker")
    onlooker = Onlooker(node)
    nodes = [subprocess.Popen(node_command(name, [name])) for name in ROBOTS]
    nodes.append(subprocess.Popen(node_command("fleet", ROBOTS)))
    robots = [subprocess.Popen([sys.executable, __file__, "--robot", name]) for name in ROBOTS]
    try:
        wait_until(node, lambda: all(robot.poll() is not None for robot in robots))
        wait_until(node, onlooker.nothing_more_comes)
    finally:
        for process in (*robots, *nodes):
            process.terminate()
        for process in (*robots, *nodes):
            process.wait()
    report(onlooker.answers)
    return 0


def report(answers: dict[str, AbsoluteOrientations]) -> None:
    """What listening to all of them is worth."""
    run = drive()
    fleet = errors_deg(answers["fleet"], run)
    print("robot  keyframes  its own node  the fleet's node   (mean error, degrees)")
    for name in ROBOTS:
        own = errors_deg(answers[name], run)[name]
        print(f"{name:5}  {len(answers[name].keyframe_ids):9}  {own:12.2f}  {fleet[name]:16.2f}")


# Small things


def wait_until(node: Node, condition: Callable[[], bool]) -> None:
    """Listen until something holds."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise SystemExit(f"{node.get_name()} waited {PATIENCE_S:.0f} s in vain")
        rclpy.spin_once(node, timeout_sec=0.1)


def to_time(nanoseconds: int) -> Time:
    """A message's stamp."""
    seconds, nanosec = divmod(nanoseconds, 1_000_000_000)
    return Time(sec=seconds, nanosec=nanosec)


def to_message(rotation: Rotation) -> Quaternion:
    """A message's rotation."""
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


if __name__ == "__main__":
    sys.exit(main())
