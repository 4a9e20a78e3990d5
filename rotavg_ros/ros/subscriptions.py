"""What the node listens to: every message is counted, translated, and handed to the estimator."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from nav_msgs.msg import Odometry
from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from rotavg_ros.online import OnlineEstimator, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.ros import adapters
from rotavg_ros.ros.conversions import to_nanoseconds, to_tuple
from rotavg_ros.ros.diagnostics import Health
from rotavg_ros.ros.message_counting import TopicCounter
from rotavg_ros.ros.outputs import Outputs
from rotavg_ros.ros.parameters import NodeParameters
from rotavg_ros.ros.topics import overrides, user_error_about

_LOG_PERIOD_S = 5.0


class Subscriptions:
    """Odometry and edges. Callbacks run on the executor's thread and stay short.

    Raises:
        UserError: a topic's name, type or ``qos_overrides`` cannot be.
    """

    def __init__(
        self, node: Node, parameters: NodeParameters, estimator: OnlineEstimator, health: Health, outputs: Outputs
    ) -> None:
        self._node = node
        self._estimator = estimator
        self._health = health
        self._outputs = outputs
        self._default_robot = parameters.robots[0]
        sensor = QoSProfile(depth=parameters.odometry_queue_depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        for robot, topic in zip(parameters.robots, parameters.odometry_topics, strict=True):
            counter = health.odometry.setdefault(topic, TopicCounter())
            self._subscribe(Odometry, topic, partial(self._on_odometry, robot), counter, sensor)
        reliable = QoSProfile(depth=parameters.edge_queue_depth, reliability=ReliabilityPolicy.RELIABLE)
        numbers = parameters.edge_sensor_orientations
        sensors = [quaternion.normalize(numbers[start : start + 4]) for start in range(0, len(numbers), 4)]
        sensors *= len(parameters.edge_topics) // len(sensors)
        for entry, sensor_orientation in zip(parameters.edge_topics, sensors, strict=True):
            edge_topic = adapters.load(entry)
            counter = health.edges.setdefault(edge_topic.topic, TopicCounter())
            on_edges = partial(self._on_edges, edge_topic.convert, sensor_orientation, counter)
            self._subscribe(edge_topic.message_type, edge_topic.topic, on_edges, counter, reliable)

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

    def _on_odometry(self, robot: str, message: Odometry, info: dict[str, Any] | None) -> None:
        started = time.perf_counter()
        position = message.pose.pose.position
        try:
            reason = self._estimator.add_odometry(
                robot,
                to_nanoseconds(message.header.stamp),
                to_tuple(message.pose.pose.orientation),
                (position.x, position.y, position.z),
            )
        except RejectedInputError as rejection:
            reason = rejection.reason
            self._estimator.reject(reason)
        if reason is None:
            self._health.last_odometry = time.monotonic()
            self._outputs.publish_orientation(robot, message)
        else:
            self._warn_of_refusal(f"odometry of {robot}", reason)
        self._health.odometry_callback.add(time.perf_counter() - started)
        if info is not None:
            self._health.odometry_latency.add(1e-9 * (time.time_ns() - info["source_timestamp"]))

    def _on_edges(
        self,
        convert: adapters.Converter,
        body_from_sensor: Quaternion,
        counter: TopicCounter,
        message: Any,
        _info: dict[str, Any] | None,
    ) -> None:
        for record in convert(message, self._default_robot, body_from_sensor):
            counter.by_sequence.observe(record.sender, record.sequence)
            if isinstance(record.edge, RejectReason):
                reason: RejectReason | None = record.edge
                self._estimator.reject(record.edge)
            else:
                reason = self._estimator.add_edge(record.edge)
            if reason is not None and reason is not RejectReason.DUPLICATE_EDGE:
                self._warn_of_refusal("an edge", reason)

    def _warn_of_refusal(self, what: str, reason: RejectReason) -> None:
        self._node.get_logger().warning(
            f"{what} refused: {reason.value} (counted in /diagnostics)", throttle_duration_sec=_LOG_PERIOD_S
        )
