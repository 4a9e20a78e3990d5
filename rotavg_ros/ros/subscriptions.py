"""What the node listens to: every message is counted, translated, and handed to the estimator."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from rotavg_ros.inputs import EdgeConverter, OdometryConverter
from rotavg_ros.online import OnlineEstimator, RejectReason
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.ros import adapters
from rotavg_ros.ros.diagnostics import Health
from rotavg_ros.ros.edge_intake import EdgeIntake
from rotavg_ros.ros.message_counting import TopicCounter
from rotavg_ros.ros.outputs import Outputs
from rotavg_ros.ros.topics import overrides, user_error_about
from rotavg_ros.settings.parameters import NodeParameters

_LOG_PERIOD_S = 5.0


class Subscriptions:
    """Odometry and edges. Callbacks run on the executor's thread and stay short.

    Raises:
        UserError: a topic's name, type or ``qos_overrides`` cannot be.
    """

    def __init__(
        self,
        node: Node,
        parameters: NodeParameters,
        estimator: OnlineEstimator,
        health: Health,
        outputs: Outputs,
        on_time_jump: Callable[[], None],
    ) -> None:
        self._node = node
        self._on_time_jump = on_time_jump
        self._estimator = estimator
        self._health = health
        self._outputs = outputs
        self._intake = EdgeIntake(node, estimator, partial(self._warn_of_refusal, "an edge"))
        best_effort = QoSProfile(depth=parameters.odometry_queue_depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        sources = zip(parameters.robots, parameters.odometry_topics, parameters.odometry_sensors(), strict=True)
        for robot, entry, body_from_sensor in sources:
            odometry = adapters.odometry_topic(entry)
            counter = health.odometry.setdefault(odometry.topic, TopicCounter())
            on_odometry = partial(self._on_odometry, robot, odometry.convert, body_from_sensor)
            self._subscribe(odometry.message_type, odometry.topic, on_odometry, counter, best_effort)
        reliable = QoSProfile(depth=parameters.edge_queue_depth, reliability=ReliabilityPolicy.RELIABLE)
        for entry, source in zip(parameters.edge_topics, parameters.edge_sources(), strict=True):
            edges = adapters.edge_topic(entry, source)
            self._intake.add_source(edges.convert)
            counter = health.edges.setdefault(edges.topic, TopicCounter())
            on_edges = partial(self._on_edges, edges.convert, counter)
            self._subscribe(edges.message_type, edges.topic, on_edges, counter, reliable)

    def _subscribe(
        self,
        message_type: type,
        topic: str,
        handle: Callable[[Any, dict[str, Any] | None], None],
        counter: TopicCounter,
        qos: QoSProfile,
    ) -> None:
        """Subscribe and count; ``handle`` gets the message, and its info where this rclpy hands it out."""
        subscription: Subscription

        def with_info(message: Any, info: dict[str, Any] | None) -> None:
            counter.observe(info, subscription.get_publisher_count() if info else 0)
            handle(message, info)

        def without_info(message: Any) -> None:
            with_info(message, None)

        # Humble's callbacks take the message alone.
        callback: Any = with_info if hasattr(Subscription, "CallbackType") else without_info
        with user_error_about(topic):
            subscription = self._node.create_subscription(
                message_type, topic, callback, qos, qos_overriding_options=overrides()
            )

    def _on_odometry(
        self,
        robot: str,
        convert: OdometryConverter,
        body_from_sensor: Quaternion,
        message: Any,
        info: dict[str, Any] | None,
    ) -> None:
        started = time.perf_counter()
        time_jumps = self._estimator.time_jumps
        try:
            record = convert(message, body_from_sensor)
        except RejectedInputError as rejection:
            reason: RejectReason | None = rejection.reason
            self._estimator.reject(rejection.reason)
        else:
            reason = self._estimator.add_odometry(robot, record.stamp_ns, record.world_from_body, record.position)
        if reason is None:
            self._health.last_odometry = time.monotonic()
            self._outputs.publish_orientation(robot, message.header)
        else:
            self._warn_of_refusal(f"odometry of {robot}", reason)
        if self._estimator.time_jumps != time_jumps:
            self._on_time_jump()
        self._health.odometry_callback.add(time.perf_counter() - started)
        if info is not None:
            self._health.odometry_latency.add(1e-9 * (time.time_ns() - info["source_timestamp"]))

    def _on_edges(
        self, convert: EdgeConverter, counter: TopicCounter, message: Any, _info: dict[str, Any] | None
    ) -> None:
        self._intake.take(convert, counter, message)

    def _warn_of_refusal(self, what: str, reason: RejectReason) -> None:
        self._node.get_logger().warning(
            f"{what} refused: {reason.value} (counted in /diagnostics)", throttle_duration_sec=_LOG_PERIOD_S
        )
