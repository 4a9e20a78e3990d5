"""Recording what a rotavg node publishes."""

from __future__ import annotations

import time

import numpy as np
import rclpy
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped
from rclpy.context import Context
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags

from rotavg_ros.evaluation.live.node_answer import NodeAnswer

_LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_SENSOR = QoSProfile(depth=1000, reliability=ReliabilityPolicy.BEST_EFFORT)

# Diagnostic values that stop changing when a node has nothing left to do.
_AT_REST = ("answer version", "answer behind", "edge messages", "odometry messages", "pending", "ticks")


def is_final(report: dict[str, str]) -> bool:
    """Whether a node's report says that its answer is a cold one and covers the whole graph."""
    return report.get("answer cold") == "true" and report.get("answer behind") == "false"


class Recorder:
    """Subscribes to a node's outputs in the root namespace; use it in a ``with`` statement and spin it."""

    def __init__(self) -> None:
        self._context = Context()
        rclpy.init(context=self._context, signal_handler_options=SignalHandlerOptions.NO)
        self._node = rclpy.create_node("rotavg_recorder", context=self._context, start_parameter_services=False)
        self._executor = SingleThreadedExecutor(context=self._context)
        self._executor.add_node(self._node)
        self._orientations: AbsoluteOrientations | None = None
        self._flags: OutlierFlags | None = None
        self._answers = 0
        self._reports: list[dict[str, str]] = []
        self.num_orientations = 0
        subscribe = self._node.create_subscription
        subscribe(AbsoluteOrientations, "abs_orientations", self._on_orientations, _LATCHED)
        subscribe(OutlierFlags, "outlier_flags", self._on_flags, _LATCHED)
        subscribe(QuaternionStamped, "orientation", self._on_orientation, _SENSOR)
        subscribe(DiagnosticArray, "/diagnostics", self._on_diagnostics, 10)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self._executor.shutdown()
        self._node.destroy_node()
        rclpy.shutdown(context=self._context)

    def spin(self, seconds: float) -> None:
        """Take what arrives within the given time."""
        deadline = time.monotonic() + seconds
        while (left := deadline - time.monotonic()) > 0:
            self._executor.spin_once(timeout_sec=left)

    @property
    def hears_node(self) -> bool:
        """Whether a node reports its diagnostics, which means that it is ready for messages."""
        return bool(self._reports)

    @property
    def last_report(self) -> dict[str, str]:
        """The node's last diagnostics, name → value; empty before the first."""
        return self._reports[-1] if self._reports else {}

    @property
    def reports(self) -> list[dict[str, str]]:
        """The node's diagnostics since the start, or since they were forgotten."""
        return list(self._reports)

    def forget_reports(self) -> None:
        """Judge only by reports that come from now on whether the node is at rest."""
        self._reports.clear()

    @property
    def is_at_rest(self) -> bool:
        """Whether the last two reports agree that the answer is final and that nothing is coming in.

        An answer that was final before the last inputs came is behind until the tick with them ends, which takes as
        long as it takes to compile the solver.
        """
        if len(self._reports) < 2:
            return False
        before, now = self._reports[-2:]
        return is_final(now) and all(before.get(key) == now.get(key) for key in _AT_REST)

    def answer(self) -> NodeAnswer | None:
        """The last answer; None if there was none."""
        orientations, flags = self._orientations, self._flags
        if orientations is None or flags is None:
            return None
        return NodeAnswer(
            keyframe_ids=np.asarray(orientations.keyframe_ids, dtype=np.uint64),
            stamps_ns=np.asarray(orientations.stamps_ns, dtype=np.int64),
            world_from_body=np.asarray(orientations.orientations, dtype=np.float64).reshape(-1, 4),
            component=np.asarray(orientations.components, dtype=np.int64),
            edge_ids=np.asarray(flags.edge_ids, dtype=np.uint64),
            source_ids=np.asarray(flags.source_ids, dtype=np.uint64),
            target_ids=np.asarray(flags.target_ids, dtype=np.uint64),
            kind=np.frombuffer(bytes(flags.kinds), dtype=np.uint8).astype(np.int64),
            score=np.asarray(flags.scores, dtype=np.float64),
            is_outlier=np.asarray(flags.outliers, dtype=bool),
            diagnostics=self.last_report,
            answers=self._answers,
        )

    def _on_orientations(self, message: AbsoluteOrientations) -> None:
        self._orientations = message
        self._answers += 1

    def _on_flags(self, message: OutlierFlags) -> None:
        self._flags = message

    def _on_orientation(self, _: QuaternionStamped) -> None:
        self.num_orientations += 1

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.endswith("rotavg: estimator"):
                self._reports.append({entry.key: entry.value for entry in status.values})
