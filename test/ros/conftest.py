"""Fixtures for tests that start executables as processes of their own and talk to them over DDS."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import pytest
from scipy.spatial.transform import Rotation

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from diagnostic_msgs.msg import DiagnosticArray
from forked_node import ForkedNode, can_fork
from geometry_msgs.msg import Quaternion, QuaternionStamped
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags, RelativeRotation, RelativeRotationArray
from std_srvs.srv import Trigger

from rotavg_ros.ros.harness.recorder import is_final

INTERFACES = Path(__file__).resolve().parents[2] / "build" / "test_interfaces" / "install"
NODE = Path(sys.executable).with_name("rotavg_node")
STARTUP_SECONDS = 150.0  # far more than needed: a loaded machine must not fail a test


class RunningProcess:
    """An executable that a test started, with everything it printed."""

    def __init__(self, command: list[str | Path], output_file: Path) -> None:
        self._output_file = output_file
        self._process: subprocess.Popen[bytes] | ForkedNode
        if command[0] == NODE and can_fork():
            self._process = ForkedNode([str(word) for word in command[1:]], output_file)
            return
        with output_file.open("wb") as sink:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    @property
    def output(self) -> str:
        """What it printed so far, on stdout and stderr together."""
        return self._output_file.read_text(encoding="utf-8", errors="replace")

    def wait(self, timeout: float = STARTUP_SECONDS) -> int:
        """Wait for its own end; returns the exit code."""
        return self._process.wait(timeout)

    def stop(self, how: signal.Signals = signal.SIGINT, timeout: float = STARTUP_SECONDS) -> int:
        """Send a signal to it alone and wait for its end; returns the exit code."""
        if self.is_running:
            self._process.send_signal(how)
        return self.wait(timeout)

    def end_for_sure(self) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.stop(signal.SIGTERM, timeout=5.0)
        if self.is_running:
            self.stop(signal.SIGKILL)


@pytest.fixture
def start_process(tmp_path: Path) -> Iterator[Callable[..., RunningProcess]]:
    """A function that starts a command, given as its words; whatever it started is ended after the test."""
    started: list[RunningProcess] = []

    def start(*command: str | Path) -> RunningProcess:
        process = RunningProcess(list(command), tmp_path / f"process_{len(started)}.txt")
        started.append(process)
        return process

    yield start
    for process in started:
        process.end_for_sure()


@pytest.fixture
def foreign_packages(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lets processes that are started from now on see others' message packages."""
    if not INTERFACES.is_dir():
        pytest.skip("others' messages are not built; `make test` or `tools/setup_environment.py --for-tests` does it")
    python = next(INTERFACES.glob("lib/python3.*/site-packages"))
    for variable, folder in (
        ("AMENT_PREFIX_PATH", INTERFACES),
        ("LD_LIBRARY_PATH", INTERFACES / "lib"),
        ("PYTHONPATH", python),
    ):
        monkeypatch.setenv(variable, str(folder), prepend=os.pathsep)
    # The ROS wheels restart Python once to set library paths; they must do so with these.
    monkeypatch.delenv("_ROS_WHEELS_BOOTSTRAP_COMPLETE", raising=False)


@pytest.fixture
def probe_node() -> Iterator[rclpy.node.Node]:
    """A node of the test's own, to publish, subscribe and look around with."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("test_probe", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """A function that waits for a condition while a process runs, and fails with its output if it ends before."""

    def wait(
        condition: Callable[[], bool], process: RunningProcess | None = None, timeout: float = STARTUP_SECONDS
    ) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if process is not None and not process.is_running:
                pytest.fail(f"the process ended with {process.wait()}:\n{process.output}")
            if time.monotonic() > deadline:
                pytest.fail(f"waited {timeout} s in vain" + (f":\n{process.output}" if process else ""))
            time.sleep(0.05)

    return wait


class LiveNode:
    """The node as a process of its own, a robot that feeds it, and everything it says.

    Attributes:
        process: the node's.
        answers, flags, orientations: messages in order of arrival.
        status: the last diagnostics' values by key, with its "level" and "message".
        reports: diagnostics so far; ``reported_at`` is the last one's stamp.
        said: level and message of every report, until somebody takes them out.
    """

    def __init__(self, probe: rclpy.node.Node, start: Callable[..., RunningProcess], wait: Callable[..., None]) -> None:
        self.probe = probe
        self.executor = SingleThreadedExecutor(context=probe.context)
        self.executor.add_node(probe)
        self._start, self._wait = start, wait
        self.answers: list[AbsoluteOrientations] = []
        self.flags: list[OutlierFlags] = []
        self.orientations: list[QuaternionStamped] = []
        self.status: dict[str, str] = {}
        self.reports = 0
        self.said: list[tuple[int, str]] = []
        self.reported_at: Time | None = None
        # Deeper than what the node keeps: a late test must not miss what the next answer follows at once.
        latched = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
        probe.create_subscription(AbsoluteOrientations, "/abs_orientations", self.answers.append, latched)
        probe.create_subscription(OutlierFlags, "/outlier_flags", self.flags.append, latched)
        probe.create_subscription(QuaternionStamped, "/orientation", self.orientations.append, 10_000)
        probe.create_subscription(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)
        keep_all = QoSProfile(depth=20_000)
        self.odometry = probe.create_publisher(Odometry, "/odom", keep_all)
        self.edges = probe.create_publisher(RelativeRotation, "/relative_rotations", keep_all)
        self.arrays = probe.create_publisher(RelativeRotationArray, "/relative_rotation_arrays", keep_all)

    def start(self, *parameters: str, reliable_odometry: bool = True, command: Sequence[str | Path] = (NODE,)) -> None:
        """Start the node and wait until both sides have found each other."""
        if reliable_odometry:  # a test decides what gets lost
            parameters += ("qos_overrides./odom.subscription.reliability:=reliable",)
        words = [word for parameter in parameters for word in ("-p", parameter)]
        self.status.clear()
        before = self._subscriptions()  # of a node that was killed and that nobody misses yet
        self.process = self._start(*command, "--ros-args", *words)
        self.spin_until(lambda: len(self._subscriptions() - before) == 3 and bool(self.status))

    def stop(self, how: signal.Signals = signal.SIGINT) -> int:
        """End the node; returns the exit code."""
        return self.process.stop(how)

    def _subscriptions(self) -> set[tuple[int, ...]]:
        """Identities of all subscriptions to what the robot publishes."""
        topics = [publisher.topic_name for publisher in (self.odometry, self.edges, self.arrays)]
        return {
            tuple(info.endpoint_gid) for topic in topics for info in self.probe.get_subscriptions_info_by_topic(topic)
        }

    def turn(self, start: int, stop: int) -> None:
        """Odometry of seconds ``start`` to ``stop``: a robot that turns on a slope, by 0.2 rad a second."""
        for index in range(start, stop):
            message = Odometry()
            message.header.stamp = Time(sec=1000 + index)
            x, y, z, w = Rotation.from_rotvec([0.1, 0, 0.2 * index]).as_quat().tolist()
            message.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
            self.odometry.publish(message)

    def spin_until(self, condition: Callable[[], bool], timeout: float = 300.0) -> None:
        """Take messages until the condition holds; fails when the node ends or the time is over."""

        def met() -> bool:
            end = time.monotonic() + 0.2
            while not condition():
                if time.monotonic() > end:
                    return False
                self.executor.spin_once(timeout_sec=0.05)
            return True

        self._wait(met, self.process, timeout)

    def spin_for(self, seconds: float) -> None:
        """Take messages for a while."""
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            self.executor.spin_once(timeout_sec=0.05)

    def wait_for_silence(self, closures: int | None = None) -> AbsoluteOrientations:
        """Wait for the cold answer after which nothing more comes; returns it.

        A report may be on its way that knows nothing of what was sent last, so the second one from now counts. On a
        busy machine a node may even be silent before the last of many messages reach it: where the number of closures
        in the graph is known, they are waited for.
        """
        reports = self.reports

        def silent() -> bool:
            if self.reports < reports + 2 or not self.answers or not is_final(self.status):
                return False
            if closures is not None and int(self.status["loop closures"]) != closures:
                return False
            complete = len(self.answers[-1].keyframe_ids) == int(self.status["keyframes"])
            return complete and float(self.status["answer age s"]) > 1

        self.spin_until(silent)
        return self.answers[-1]

    def call(self, service: str, service_type: type = Trigger, **request: Any) -> Any:
        """Call one of the node's services; returns the response."""
        client = self.probe.create_client(service_type, f"/rotavg/{service}")
        self.spin_until(client.service_is_ready)
        future = client.call_async(service_type.Request(**request))
        self.spin_until(future.done)
        self.probe.destroy_client(client)
        return future.result()

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        status = message.status[0]
        self.reports += 1
        self.said.append((ord(status.level), status.message))
        self.reported_at = message.header.stamp
        self.status = {pair.key: pair.value for pair in status.values}
        self.status |= {"level": str(ord(status.level)), "message": status.message, "name": status.name}


@pytest.fixture
def live_node(probe_node: rclpy.node.Node, start_process: Callable, wait_until: Callable) -> Iterator[LiveNode]:
    """A :class:`LiveNode`, not yet started."""
    live = LiveNode(probe_node, start_process, wait_until)
    yield live
    live.executor.shutdown()
