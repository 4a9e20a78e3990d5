from __future__ import annotations

import re
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import rclpy
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
from rotavg_msgs.msg import RelativeRotation

from rotavg_ros.bags.run_bag import write_run_bag
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.simulation.robot_run import RobotRun
from rotavg_ros.datasets.simulation.slam_simulation import SimulatedRun, simulate_slam_graph
from rotavg_ros.ros.harness import player as harness_player

pytestmark = pytest.mark.ros

ROTAVG = [sys.executable, "-m", "rotavg_ros.cli.main"]


@pytest.fixture(scope="module")
def run() -> SimulatedRun:
    return simulate_slam_graph(RobotRun(laps=1).config(), np.random.default_rng(0))


@pytest.fixture(scope="module")
def bag(run: SimulatedRun, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("bags") / "run"
    write_run_bag(folder, run)
    return folder


class Listener:
    """Everything that arrives."""

    def __init__(self, node: rclpy.node.Node, reliability: ReliabilityPolicy = ReliabilityPolicy.RELIABLE) -> None:
        self.odometry: list[Odometry] = []
        self.edges: list[RelativeRotation] = []
        self.clock: list[Clock] = []
        odometry = QoSProfile(depth=5000, reliability=reliability)
        node.create_subscription(Odometry, "odom", self.odometry.append, odometry)
        node.create_subscription(RelativeRotation, "relative_rotations", self.edges.append, 5000)
        node.create_subscription(Clock, "clock", self.clock.append, 5000)
        self._executor = SingleThreadedExecutor(context=node.context)
        self._executor.add_node(node)

    def spin_until(self, condition: Callable[[], bool], timeout: float = 300.0) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            assert time.monotonic() < deadline, f"{len(self.odometry)} odometry, {len(self.edges)} edges so far"
            self._executor.spin_once(timeout_sec=0.05)


def stamp_ns(time: Time) -> int:
    return time.sec * 10**9 + time.nanosec


def test_a_burst_arrives_whole_and_unchanged(
    run: SimulatedRun, bag: Path, probe_node: rclpy.node.Node, start_process: Callable
) -> None:
    listener = Listener(probe_node)
    player = start_process(*ROTAVG, "play", bag, "--rate", "0", "--clock")
    listener.spin_until(lambda: not player.is_running)
    assert player.wait() == 0, player.output
    num_closures = int((~run.graph.is_odometry).sum())
    last = run.stamps_ns[-1].item()
    listener.spin_until(lambda: len(listener.odometry) == 1500 and len(listener.edges) == num_closures)
    listener.spin_until(lambda: bool(listener.clock) and stamp_ns(listener.clock[-1].clock) == last)
    stamps = [stamp_ns(message.header.stamp) for message in listener.odometry]
    assert stamps == run.stamps_ns.tolist()
    assert [edge.sequence for edge in listener.edges] == list(range(1, num_closures + 1))
    orientation = listener.odometry[-1].pose.pose.orientation
    np.testing.assert_allclose(
        [orientation.x, orientation.y, orientation.z, orientation.w], run.odometry_world_from_body[-1], atol=1e-15
    )
    clock = [stamp_ns(message.clock) for message in listener.clock]
    assert clock == sorted(clock)
    assert f"{1500} on /odom" in player.output


@pytest.mark.large
def test_the_rate_is_kept_for_a_sensor_subscriber(
    bag: Path, probe_node: rclpy.node.Node, start_process: Callable
) -> None:
    listener = Listener(probe_node, ReliabilityPolicy.BEST_EFFORT)  # which may miss a message on a loaded machine
    player = start_process(*ROTAVG, "play", bag, "--rate", "50", "--topics", "/odom")
    listener.spin_until(lambda: not player.is_running)
    assert player.wait() == 0
    assert len(listener.odometry) > 0
    assert not listener.edges
    played = re.match(r"played 1500 messages in ([\d.]+) s", player.output)
    # 149.9 s of bag at 50 times real time; a loaded machine may be later, but nothing may be early.
    assert played is not None and float(played[1]) >= 2.9


def test_nobody_listens(bag: Path, start_process: Callable) -> None:
    player = start_process(*ROTAVG, "play", bag, "--wait-for-subscribers", "0.5")
    assert player.wait() == 2
    assert "nobody subscribed" in player.output
    assert player.output.count("\n") == 1


# It gets one of the topics reliably, and hangs after some messages on that.
HANGS = """
import os, signal, sys, rclpy
from nav_msgs.msg import Odometry
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rosgraph_msgs.msg import Clock
rclpy.init()
node, seen = rclpy.create_node("hangs"), []
def hang(message):
    seen.append(message)
    if len(seen) == 20:
        os.kill(os.getpid(), signal.SIGSTOP)
for topic, kind in (("/odom", Odometry), ("/clock", Clock)):
    is_it = topic == sys.argv[1]
    qos = QoSProfile(depth=10_000, reliability=ReliabilityPolicy.RELIABLE if is_it else ReliabilityPolicy.BEST_EFFORT)
    node.create_subscription(kind, topic, hang if is_it else lambda _: None, qos)
rclpy.spin(node)
"""


@pytest.mark.parametrize("topic", ["/odom", "/clock"])
def test_a_subscriber_that_hangs_is_told_of(
    bag: Path, start_process: Callable, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture, topic: str
) -> None:
    """And so is waited for before that: the last time on the clock was lost where a machine was busy."""
    monkeypatch.setattr(harness_player, "_ACKNOWLEDGE_TIMEOUT_S", 0.5)
    subscriber = start_process(sys.executable, "-c", HANGS, topic)
    assert main(["play", str(bag), "--rate", "0", "--clock", "--wait-for-subscribers", "150"]) == 2
    said = capsys.readouterr()
    assert f"0.5 s later a reliable subscriber of {topic} has not got everything" in said.err and not said.out
    subscriber.stop(signal.SIGKILL)  # it hears no other


@pytest.mark.large
def test_plays_to_nobody_when_told_so(bag: Path, start_process: Callable) -> None:
    player = start_process(*ROTAVG, "play", bag, "--wait-for-subscribers", "0", "--rate", "0")
    assert player.wait() == 0
    assert "played" in player.output


@pytest.mark.parametrize("playing", [pytest.param(False, marks=pytest.mark.large), True])
def test_interrupted(
    bag: Path, probe_node: rclpy.node.Node, start_process: Callable, playing: bool, wait_until: Callable
) -> None:
    player = start_process(*ROTAVG, "play", bag, "--rate", "1", "--wait-for-subscribers", "60")
    if playing:
        listener = Listener(probe_node)
        listener.spin_until(lambda: len(listener.odometry) > 0)
    else:
        wait_until(lambda: "rotavg_player" in probe_node.get_node_names(), player)
    assert player.stop(signal.SIGINT) == 130
    assert "Traceback" not in player.output


@pytest.mark.parametrize(
    ("options", "complaint"),
    [
        (["--topics", "/lidar"], "no topic /lidar; the bag has /ground_truth, /odom"),
        (["--rate", "-1"], "--rate: is -1; it must be 0 or more"),
        (["--max-messages-per-second", "0"], "must be positive"),
    ],
)
def test_mistakes_are_one_line(
    bag: Path, capsys: pytest.CaptureFixture[str], options: list[str], complaint: str
) -> None:
    assert main(["play", str(bag), *options]) == 2
    said = capsys.readouterr()
    assert complaint in said.err
    assert (said.out, said.err.count("\n")) == ("", 1)


def test_a_ros1_bag(shared_data: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["play", str(shared_data / "bags" / "husky_test1.bag")]) == 2
    assert "is a ROS 1 bag" in capsys.readouterr().err
