"""The node under load: a large graph over DDS, a few more keyframes every second, and odometry at a high rate."""

from __future__ import annotations

import os
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
import rclpy
from nav_msgs.msg import Odometry
from rclpy.context import Context
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rotavg_msgs.msg import KeyframeReference, RelativeRotation, RelativeRotationArray

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.slam_simulation import SlamSimulationConfig, simulate_slam_graph
from rotavg_ros.datasets.simulation.trajectories import World
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.ros.harness import process_family
from rotavg_ros.ros.harness.live_run import LiveRunError, installed_node, keep_to_this_machine, stop_process
from rotavg_ros.ros.harness.recorder import Recorder, is_final
from rotavg_ros.ros.node.output.conversions import to_quaternion_message
from rotavg_ros.view_graph import ViewGraph

RATES_HZ = (50.0, 200.0)
_KEYFRAMES_PER_SECOND = 4.0
_EDGES_PER_MESSAGE = 500
_PAUSE_S = 0.05
_TURN_RATE = 0.2  # rad/s
_TIMEOUT_S = 600.0
_SETTLE_S = 1.0  # a subscription that this side has found has not always found this side yet
_ODOMETRY_TOPIC, _EDGE_TOPIC = "odom", "relative_rotation_arrays"


@dataclass(frozen=True)
class Load:
    """The load of a node.

    Attributes:
        keyframes: number of keyframes in the graph, with as many loop closures.
        seconds: duration, once the graph has been solved; four more keyframes come every second.
        rate_hz: rate of odometry.
        cores: number of cores that it may use; 0: all.
    """

    keyframes: int
    seconds: float
    rate_hz: float
    cores: int = 0


@dataclass(frozen=True)
class SoakRow:
    """What the node reported at one rate (milliseconds and counts), and the CPU time and memory that it took.

    Ticks are those after the graph was solved; ``start_max_ms`` is the longest one before. ``cpu_share`` is the number
    of cores busy, the solver's process included. ``node_mb`` and ``solver_mb`` are the peaks of the two processes, 10⁶
    bytes, each including shared memory; ``both_mb`` is their sum at the end, in which shared memory counts once.
    """

    rate_hz: float
    keyframes: int
    edges: int
    ticks: int
    tick_p50_ms: float
    tick_p95_ms: float
    tick_max_ms: float
    start_max_ms: float
    callback_p95_ms: float
    latency_p95_ms: float
    cpu_share: float
    sent: int
    lost: int
    node_mb: float
    solver_mb: float
    both_mb: float
    cores: int


def table(rows: Sequence[SoakRow]) -> Table:
    """The rows as a table."""
    columns = (
        Column("odometry Hz", ".0f"),
        Column("keyframes"),
        Column("edges"),
        Column("ticks"),
        Column("tick p50 ms", ".1f"),
        Column("tick p95 ms", ".1f"),
        Column("tick max ms", ".1f"),
        Column("max before ms", ".1f"),
        Column("callback p95 ms", ".2f"),
        Column("latency p95 ms", ".2f"),
        Column("cores busy", ".2f"),
        Column("messages sent"),
        Column("lost"),
        Column("node MB", ".0f"),
        Column("solver MB", ".0f"),
        Column("both at the end MB", ".0f"),
    )
    return Table("Ticks and callbacks", columns, tuple(tuple(vars(row).values())[: len(columns)] for row in rows))


def run(num_keyframes: int, seconds: float, rates_hz: Sequence[float] = RATES_HZ) -> list[SoakRow]:
    """One node per rate, see :func:`run_loads`."""
    return run_loads([Load(num_keyframes, seconds, rate_hz) for rate_hz in rates_hz])


def run_loads(
    loads: Sequence[Load], watch: Callable[[Iterable[Load]], Iterable[Load]] = lambda loads: loads
) -> list[SoakRow]:
    """Run one node after the other.

    Args:
        loads: the load of each.
        watch: passes them through and may show the progress.

    Raises:
        LiveRunError: the node is not installed, died, or did not take the graph.
    """
    keep_to_this_machine()
    return [_soak(_city(load), load) for load in watch(loads)]


def _city(load: Load) -> ViewGraph:
    coming = round(load.seconds * _KEYFRAMES_PER_SECOND)
    config = SlamSimulationConfig(
        world=World.CITY,
        num_keyframes=load.keyframes + coming,
        laps=8,
        keyframe_distance_m=2.0,
        closure_radius_m=6.0,
        closures_per_keyframe=1.0,
        false_share=0.1,
    )
    return simulate_slam_graph(config, np.random.default_rng(0)).graph


def _soak(graph: ViewGraph, load: Load) -> SoakRow:
    num_keyframes, seconds, rate_hz = load.keyframes, load.seconds, load.rate_hz
    settings = ["-p", "keyframe_source:=edges", "-p", "unknown_keyframes:=create"]
    pinned = ["taskset", "-c", ",".join(map(str, _cores(load.cores)))] if load.cores else []
    with tempfile.TemporaryFile() as log, Recorder() as recorder, _Sender(graph) as sender:
        node = subprocess.Popen(
            [*pinned, installed_node(), "--ros-args", *settings],
            stdin=subprocess.DEVNULL,
            stdout=log,
            stderr=subprocess.STDOUT,
        )
        try:
            _wait(recorder, node, lambda _: sender.is_heard, "did not start")
            time.sleep(_SETTLE_S)
            sender.send_edges_up_to(num_keyframes)
            _wait(recorder, node, lambda report: int(report["keyframes"]) >= num_keyframes, "did not take the graph")
            before = _wait(recorder, node, is_final, "did not solve the graph")
            recorder.forget_reports()
            start, cpu_start = time.monotonic(), process_family.cpu_seconds(node.pid)
            while (elapsed := time.monotonic() - start) < seconds:
                sender.send_odometry_up_to(round(elapsed * rate_hz), rate_hz)
                sender.send_edges_up_to(num_keyframes + int(elapsed * _KEYFRAMES_PER_SECOND))
                recorder.spin(0.5 / rate_hz)
            cpu_share = (process_family.cpu_seconds(node.pid) - cpu_start) / (time.monotonic() - start)
            solvers_mb = sum(map(process_family.peak_memory_mb, process_family.children(node.pid)))
            node_mb = process_family.peak_memory_mb(node.pid)
            both_mb = process_family.memory_mb(node.pid)
            known = len(recorder.reports)
            report = _wait(recorder, node, lambda _: len(recorder.reports) > known, "fell silent")
            ticks_ms = [float(tick) for one in recorder.reports for tick in one["latest ticks ms"].split()]
        finally:
            stop_process(node)
    median, p95, longest = np.percentile(ticks_ms or [np.nan], (50, 95, 100)).tolist()
    return SoakRow(
        rate_hz,
        int(report["keyframes"]),
        int(report["edges"]),
        len(ticks_ms),
        median,
        p95,
        longest,
        float(before["tick max ms"]),
        float(report["odometry callback p95 ms"]),
        float(report["odometry latency p95 ms"]),
        cpu_share,
        sender.odometry_sent,
        int(report["lost messages"]),
        node_mb,
        solvers_mb,
        both_mb,
        load.cores,
    )


def _cores(count: int) -> list[int]:
    """The first ``count`` of the cores that this process may use."""
    return sorted(os.sched_getaffinity(0))[:count]


def _wait(
    recorder: Recorder, node: subprocess.Popen[bytes], arrived: Callable[[dict[str, str]], bool], failure: str
) -> dict[str, str]:
    """Spin until a report of the node's diagnostics fulfils the condition; returns that report."""
    deadline = time.monotonic() + _TIMEOUT_S
    while not ((report := recorder.last_report) and arrived(report)):
        recorder.spin(0.1)
        if node.poll() is not None:
            raise LiveRunError(f"the node died with exit code {node.returncode}")
        if time.monotonic() > deadline:
            raise LiveRunError(f"the node {failure} within {_TIMEOUT_S:.0f} s")
    return report


class _Sender:
    """Publishes a graph's edges, and odometry of a robot that turns; use it in a ``with`` statement."""

    def __init__(self, graph: ViewGraph) -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("rotavg_soak", context=self._context, start_parameter_services=False)
        reliable = QoSProfile(depth=1000, reliability=ReliabilityPolicy.RELIABLE)
        best_effort = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._edges = self._node.create_publisher(RelativeRotationArray, _EDGE_TOPIC, reliable)
        self._odometry = self._node.create_publisher(Odometry, _ODOMETRY_TOPIC, best_effort)
        # An edge can be sent when the later of its ends is there; the graph has them in this order.
        self._arrival = np.maximum(graph.source.numpy(), graph.target.numpy())
        self._messages = _edge_messages(graph)
        self._edges_sent = 0
        self.odometry_sent = 0

    def __enter__(self) -> _Sender:
        return self

    def __exit__(self, *_: object) -> None:
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    @property
    def is_heard(self) -> bool:
        """Whether both topics have subscribers; edges sent before are lost, and the graph would stay disconnected."""
        return all(publisher.get_subscription_count() for publisher in (self._edges, self._odometry))

    def send_edges_up_to(self, num_keyframes: int) -> None:
        """Send the edges between the first ``num_keyframes`` keyframes that have not been sent yet."""
        end = int(np.searchsorted(self._arrival, num_keyframes))
        for start in range(self._edges_sent, end, _EDGES_PER_MESSAGE):
            part = self._messages[start : min(start + _EDGES_PER_MESSAGE, end)]
            self._edges.publish(RelativeRotationArray(edges=part))
            time.sleep(_PAUSE_S if len(part) == _EDGES_PER_MESSAGE else 0)
        self._edges_sent = end

    def send_odometry_up_to(self, count: int, rate_hz: float) -> None:
        """Send messages until there have been ``count`` in all; their stamps are the present time."""
        while self.odometry_sent < count:
            message = Odometry()
            message.header.stamp = self._node.get_clock().now().to_msg()
            half_angle = 0.5 * _TURN_RATE * self.odometry_sent / rate_hz
            message.pose.pose.orientation = to_quaternion_message((0.0, 0.0, np.sin(half_angle), np.cos(half_angle)))
            self._odometry.publish(message)
            self.odometry_sent += 1


def _edge_messages(graph: ViewGraph) -> list[RelativeRotation]:
    """The graph's edges as messages, which state the target's orientation in the source's frame."""
    columns = (graph.source, graph.target, rotations.inverse(graph.target_from_source), graph.kind, graph.precision)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    return [
        RelativeRotation(
            id=number,
            sequence=number,
            source=KeyframeReference(by=KeyframeReference.BY_ID, id=source),
            target=KeyframeReference(by=KeyframeReference.BY_ID, id=target),
            rotation=to_quaternion_message(rotation),
            kind=kind,
            precision=precision,
        )
        for number, (source, target, rotation, kind, precision) in enumerate(rows)
    ]
