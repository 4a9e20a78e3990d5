"""The node's subscriptions: every message is counted, converted, and handed to the estimator."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from typing import Any

from rclpy.node import Node
from rclpy.qos import QoSProfile, ReliabilityPolicy
from rclpy.subscription import Subscription

from rotavg_ros.errors import UserError
from rotavg_ros.inputs import OdometryConverter
from rotavg_ros.online import OnlineEstimator, RejectReason
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.ros.node.health import Health
from rotavg_ros.ros.node.intake import adapters
from rotavg_ros.ros.node.intake.adapters import EdgeTopic, OdometryTopic
from rotavg_ros.ros.node.intake.edge_intake import EdgeIntake
from rotavg_ros.ros.node.intake.forwarding import Forwarding
from rotavg_ros.ros.node.intake.serialized_array import SerializedArray
from rotavg_ros.ros.node.intake.wiring import Input
from rotavg_ros.ros.node.message_counting import TopicCounter
from rotavg_ros.ros.node.output.outputs import Outputs
from rotavg_ros.ros.node.topics import overrides, user_error_about
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.view_graph import EdgeLabel

_LOG_PERIOD_S = 5.0


class Subscriptions:
    """Odometry and edges. Callbacks run on the executor's thread and stay short.

    Attributes:
        inputs: the topics that are listened to.
        forwarding: where believed closures go.

    Raises:
        UserError: an invalid topic name, type or ``qos_overrides``.
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
        self.inputs: list[Input] = []
        self.forwarding = Forwarding(node, parameters, estimator)
        self._intake = EdgeIntake(
            node,
            estimator,
            self.forwarding,
            partial(self._warn_of_refusal, "an edge"),
            parameters.edge_frame_wait_s if parameters.places_edges_by_tf else None,
        )
        best_effort = QoSProfile(depth=parameters.odometry_queue_depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        sources = zip(parameters.robots, parameters.odometry_topics, parameters.odometry_sensors(), strict=True)
        for robot, entry, body_from_sensor in sources:
            odometry = adapters.odometry_topic(entry)
            topic = Input(self._full_name(odometry.topic), odometry.type_name, "odometry_topics", robot, best_effort)
            counter = health.odometry.setdefault(topic.name, TopicCounter())
            on_odometry = partial(self._on_odometry, topic, odometry.convert, body_from_sensor)
            self._subscribe(topic, odometry, on_odometry, counter)
        reliable = QoSProfile(depth=parameters.edge_queue_depth, reliability=ReliabilityPolicy.RELIABLE)
        for entry, source in zip(parameters.edge_topics, parameters.edge_sources(), strict=True):
            edges = adapters.edge_topic(entry, source.into(estimator))
            self._intake.add_source(edges.convert)
            topic = Input(self._full_name(edges.topic), edges.type_name, "edge_topics", "", reliable)
            topic.forward = self.forwarding.of(edges)
            counter = health.edges.setdefault(topic.name, TopicCounter())
            on_edges = partial(self._on_edges, topic, edges, counter)
            self._subscribe(topic, edges, on_edges, counter)

    @property
    def waiting_for_frames(self) -> int:
        """Number of edges that wait for the transform between their frame and the body's."""
        return self._intake.frames.waiting

    def label_edge(self, source_robot: str, edge_id: int, label: EdgeLabel) -> int:
        """See :meth:`EdgeIntake.label_edge`."""
        return self._intake.label_edge(source_robot, edge_id, label)

    def _full_name(self, topic: str) -> str:
        """The topic's name with the namespace and remappings.

        Raises:
            UserError: an invalid topic name, or one that another entry resolves to as well.
        """
        with user_error_about(topic):
            name: str = self._node.resolve_topic_name(topic)
        if any(each.name == name for each in self.inputs):
            raise UserError(f"topic {topic} is {name}, which is listened to already; name it once")
        return name

    def _subscribe(
        self,
        topic: Input,
        entry: OdometryTopic | EdgeTopic,
        handle: Callable[[Any, dict[str, Any] | None], None],
        counter: TopicCounter,
    ) -> None:
        """Subscribe and count; ``handle`` gets the message, and its info if this rclpy provides it."""
        subscription: Subscription
        self.inputs.append(topic)

        def with_info(message: Any, info: dict[str, Any] | None) -> None:
            counter.observe(info, subscription.get_publisher_count() if info else 0)
            handle(message, info)

        def without_info(message: Any) -> None:
            with_info(message, None)

        # In Humble, callbacks take only the message.
        callback: Any = with_info if hasattr(Subscription, "CallbackType") else without_info
        with user_error_about(topic.name):
            subscription = self._node.create_subscription(
                entry.message_type,
                entry.topic,
                callback,
                topic.qos,
                callback_group=None if topic.is_odometry else self._intake.callback_group,
                qos_overriding_options=overrides(),
                raw=isinstance(entry, EdgeTopic) and entry.is_array,
            )

    def _on_odometry(
        self,
        topic: Input,
        convert: OdometryConverter,
        body_from_sensor: Quaternion,
        message: Any,
        info: dict[str, Any] | None,
    ) -> None:
        if info is not None and (received_ns := info.get("received_timestamp")):  # 0: the middleware does not say
            self._health.odometry_wait.add(1e-9 * (time.time_ns() - received_ns))
        started = time.perf_counter()
        time_jumps = self._estimator.time_jumps
        try:
            record = convert(message, body_from_sensor)
        except RejectedInputError as rejection:
            reason: RejectReason | None = rejection.reason
            self._estimator.reject(rejection.reason)
        else:
            topic.note_frames(record.frame_id, record.child_frame_id)
            self._intake.frames.note_body(topic.robot, record.child_frame_id, body_from_sensor)
            measured = record.stamp_ns, record.world_from_body, record.position
            reason = self._estimator.add_odometry(topic.robot, *measured, body_from_sensor)
        if reason is None:
            self._health.took_odometry(topic.name)
            self._outputs.publish_odometry(topic.robot, topic.name, message, record)
        else:
            self._health.refused_odometry(topic.name, reason.value)
            self._warn_of_refusal(f"odometry of {topic.robot}", reason)
        if self._estimator.time_jumps != time_jumps:
            self._on_time_jump()
        self._health.odometry_callback.add(time.perf_counter() - started)
        if info is not None:
            self._health.odometry_latency.add(1e-9 * (time.time_ns() - info["source_timestamp"]))

    def _on_edges(
        self, topic: Input, edges: EdgeTopic, counter: TopicCounter, message: Any, _info: dict[str, Any] | None
    ) -> None:
        unpacked = SerializedArray(message, edges.message_type) if edges.is_array else message
        records = edges.convert(unpacked)
        if topic.forward is not None:
            records = topic.forward.begin(unpacked, records)
        self._intake.take(topic, counter, records)

    def _warn_of_refusal(self, what: str, reason: RejectReason) -> None:
        self._node.get_logger().warning(
            f"{what} refused: {reason.value} (counted in /diagnostics)", throttle_duration_sec=_LOG_PERIOD_S
        )
