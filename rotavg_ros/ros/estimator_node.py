"""The ROS node: messages in, messages out. What they mean is decided in :mod:`rotavg_ros.online`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import torch
from diagnostic_msgs.msg import DiagnosticArray
from geometry_msgs.msg import QuaternionStamped, TransformStamped
from nav_msgs.msg import Odometry
from nav_msgs.msg import Path as PathMessage
from rclpy.clock import Clock, ClockType  # type: ignore[attr-defined]
from rclpy.executors import Executor
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions
from rclpy.subscription import Subscription
from rclpy.timer import Timer
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags
from rotavg_msgs.srv import LabelEdge
from std_srvs.srv import SetBool, Trigger
from visualization_msgs.msg import MarkerArray

from rotavg_ros.errors import UserError
from rotavg_ros.online import Answer, OnlineEstimator, RejectReason, quaternion
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.ros import adapters, parameter_server
from rotavg_ros.ros.conversions import (
    flags_message,
    orientations_message,
    to_nanoseconds,
    to_quaternion_message,
    to_tuple,
)
from rotavg_ros.ros.diagnostics import Health, Reporter
from rotavg_ros.ros.message_counting import TopicCounter
from rotavg_ros.ros.parameters import NODE_NAME, NodeParameters
from rotavg_ros.ros.visualization import markers_message, path_message
from rotavg_ros.ros.warm_up import warm_up
from rotavg_ros.ros.worker import Worker
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeLabel

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)
_LOG_PERIOD_S = 5.0


@contextmanager
def _user_error_about(topic: str) -> Iterator[None]:
    """What rclpy says about a topic's name or its ``qos_overrides``, in one line."""
    try:
        yield
    except Exception as error:  # rclpy has a different type for every mistake
        raise UserError(f"topic {topic}: {' '.join(str(error).split())}") from error


def _overrides() -> QoSOverridingOptions:
    """History, depth and reliability may be set by ``qos_overrides.<topic>…`` parameters."""
    return QoSOverridingOptions.with_default_policies()


class RotavgNode(Node):
    """Subscriptions, publications, services and timers around an :class:`OnlineEstimator`.

    Callbacks run on the executor's thread and stay short; solving, saving and publishing answers happen on a worker.

    Raises:
        UserError: parameters that cannot be; the message is one line for the user.
    """

    def __init__(self, executor: Executor) -> None:
        super().__init__(NODE_NAME)
        self._settings = parameter_server.declare(self)
        parameters = self._settings
        torch.set_num_threads(parameters.solver_threads or max(1, torch.get_num_threads() - 1))
        device = warm_up(parameters.estimator_options())
        self._estimator = OnlineEstimator(parameters.estimator_options())
        self._state_file = Path(parameters.state_file) if parameters.state_file else None
        if self._state_file is not None:
            self._resume(self._state_file)
        self._health = Health()
        self._reporter = Reporter(f"{self.get_fully_qualified_name().lstrip('/')}: estimator")
        self._worker = Worker(executor)
        self._tick_queued = False
        self._drawn_version = 0
        self._saved_revision = self._estimator.revision
        self._create_publishers()
        self._create_subscriptions()
        self._create_services()
        self._steady = Clock(clock_type=ClockType.STEADY_TIME)  # ticks though /clock is paused or absent
        self._solve_timer = self._create_timer(parameters.solve_period_s, self._on_solve_timer)
        self._create_timer(1.0, self._on_diagnostics_timer)
        if parameters.autosave_period_s > 0:
            self._create_timer(parameters.autosave_period_s, self._on_autosave_timer)
        parameter_server.watch(self, lambda: self._settings, self._apply)
        topics = ", ".join([*parameters.odometry_topics, *parameters.edge_topics])
        self.get_logger().info(f"rotavg {__version__} on {device}, listening to {topics}")
        for line in parameter_server.unknown(self):
            self.get_logger().warning(line)

    def close(self, timeout_s: float) -> bool:
        """Stop working; False if a solve is still running after the timeout."""
        return self._worker.stop(timeout_s)

    # Wiring

    def _create_publishers(self) -> None:
        latched = partial(self._publisher, qos=LATCHED)
        self._orientations = latched(AbsoluteOrientations, "abs_orientations")
        self._flags = latched(OutlierFlags, "outlier_flags")
        self._markers = latched(MarkerArray, "~/markers")
        robots = self._settings.robots
        prefix = {robot: f"{robot}/" if len(robots) > 1 else "" for robot in robots}
        self._paths = {robot: latched(PathMessage, f"{prefix[robot]}corrected_path") for robot in robots}
        self._orientation = {
            robot: self._publisher(QuaternionStamped, f"{prefix[robot]}orientation", QoSProfile(depth=10))
            for robot in robots
        }
        self._diagnostics = self.create_publisher(DiagnosticArray, "/diagnostics", 10)
        self._tf: Publisher | None = None
        if self._settings.publish_tf:
            try:
                from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
            except ImportError as error:
                raise UserError("publish_tf needs tf2_msgs: install that package or leave publish_tf off") from error
            self._tf_message = TFMessage
            self._tf = self._publisher(TFMessage, "/tf", QoSProfile(depth=100))

    def _publisher(self, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
        with _user_error_about(topic):
            return self.create_publisher(message_type, topic, qos, qos_overriding_options=_overrides())

    def _create_subscriptions(self) -> None:
        parameters = self._settings
        sensor = QoSProfile(depth=parameters.odometry_queue_depth, reliability=ReliabilityPolicy.BEST_EFFORT)
        for robot, topic in zip(parameters.robots, parameters.odometry_topics, strict=True):
            counter = self._health.odometry.setdefault(topic, TopicCounter())
            self._subscribe(Odometry, topic, partial(self._on_odometry, robot), counter, sensor)
        reliable = QoSProfile(depth=parameters.edge_queue_depth, reliability=ReliabilityPolicy.RELIABLE)
        numbers = parameters.edge_sensor_orientations
        sensors = [quaternion.normalize(numbers[start : start + 4]) for start in range(0, len(numbers), 4)]
        sensors *= len(parameters.edge_topics) // len(sensors)
        for entry, sensor_orientation in zip(parameters.edge_topics, sensors, strict=True):
            edge_topic = adapters.load(entry)
            counter = self._health.edges.setdefault(edge_topic.topic, TopicCounter())
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
        with _user_error_about(topic):
            subscription = self.create_subscription(
                message_type, topic, callback, qos, qos_overriding_options=_overrides()
            )

    def _create_services(self) -> None:
        self.create_service(Trigger, "~/reset", partial(self._on_trigger, self._reset))
        self.create_service(Trigger, "~/solve_now", partial(self._on_trigger, self._solve_now))
        self.create_service(Trigger, "~/save", partial(self._on_trigger, self._save))
        self.create_service(Trigger, "~/load", partial(self._on_trigger, self._load))
        self.create_service(SetBool, "~/pause", self._on_pause)
        self.create_service(LabelEdge, "~/label_edge", self._on_label_edge)

    def _create_timer(self, period_s: float, callback: Callable[[], None]) -> Timer:
        return self.create_timer(period_s, callback, clock=self._steady)

    def _apply(self, parameters: NodeParameters) -> None:
        """Put changed parameters into force.

        Raises:
            UserError: the solver does not know its options; nothing has changed then.
        """
        old, options = self._settings, parameters.estimator_options()
        if (options.method, options.profile) != (self._estimator.options.method, self._estimator.options.profile):
            warm_up(options)
        if options != self._estimator.options:
            self._estimator.set_options(options)
        self._settings = parameters
        if parameters.solve_period_s != old.solve_period_s:
            self.destroy_timer(self._solve_timer)
            self._solve_timer = self._create_timer(parameters.solve_period_s, self._on_solve_timer)

    # Inputs

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
            self._publish_orientation(robot, message)
        else:
            self._warn_of_refusal(f"odometry of {robot}", reason)
        self._health.odometry_callback.add(time.perf_counter() - started)
        if info is not None:
            self._health.odometry_latency.add(1e-9 * (time.time_ns() - info["source_timestamp"]))

    def _publish_orientation(self, robot: str, message: Odometry) -> None:
        orientation = self._estimator.current_orientation(robot)
        if orientation is None:
            return
        stamped = QuaternionStamped(quaternion=to_quaternion_message(orientation))
        stamped.header.stamp = message.header.stamp
        stamped.header.frame_id = self._settings.world_frame
        self._orientation[robot].publish(stamped)
        correction = self._estimator.world_from_odometry(robot) if self._tf is not None else None
        if self._tf is not None and correction is not None:
            transform = TransformStamped(header=stamped.header, child_frame_id=message.header.frame_id)
            transform.transform.rotation = to_quaternion_message(correction)
            self._tf.publish(self._tf_message(transforms=[transform]))

    def _on_edges(
        self,
        convert: adapters.Converter,
        body_from_sensor: Quaternion,
        counter: TopicCounter,
        message: Any,
        _info: dict[str, Any] | None,
    ) -> None:
        for record in convert(message, self._settings.robots[0], body_from_sensor):
            counter.by_sequence.observe(record.sender, record.sequence)
            if isinstance(record.edge, RejectReason):
                reason: RejectReason | None = record.edge
                self._estimator.reject(record.edge)
            else:
                reason = self._estimator.add_edge(record.edge)
            if reason is not None and reason is not RejectReason.DUPLICATE_EDGE:
                self._warn_of_refusal("an edge", reason)

    def _warn_of_refusal(self, what: str, reason: RejectReason) -> None:
        self.get_logger().warning(
            f"{what} refused: {reason.value} (counted in /diagnostics)", throttle_duration_sec=_LOG_PERIOD_S
        )

    # On the worker

    def _on_solve_timer(self) -> None:
        if not self._tick_queued:
            self._tick_queued = True
            self._worker.submit(self._tick_quietly)

    def _tick_quietly(self) -> None:
        try:
            self._tick()
        except Exception as error:
            self.get_logger().error(f"solving failed: {error}", throttle_duration_sec=_LOG_PERIOD_S)
        finally:
            self._tick_queued = False

    def _tick(self, force_cold: bool = False) -> Answer | None:
        health = self._health
        if self._estimator.is_behind and health.unsolved_since is None:
            health.unsolved_since = time.monotonic()
        try:
            answer = self._estimator.tick(force_cold)
        except Exception as error:
            health.solve_failures += 1
            health.failure = str(error)
            raise
        health.failure = None
        if answer is not None:
            self._publish_answer(answer)
        return answer

    def _publish_answer(self, answer: Answer) -> None:
        health, frame_id = self._health, self._settings.world_frame
        if health.answer is not None and 0 < answer.num_components < health.answer.num_components:
            self.get_logger().info(f"components joined: {answer.num_components} now")
        self._orientations.publish(orientations_message(answer, frame_id))
        self._flags.publish(flags_message(answer, frame_id))
        health.ticks.add(answer.seconds)
        health.answer, health.answered, health.unsolved_since = answer, time.monotonic(), None
        self._draw()

    def _draw(self) -> None:
        """Path and markers of the last answer, for those who look; again when somebody begins to."""
        answer, frame_id = self._health.answer, self._settings.world_frame
        watched = {robot: path for robot, path in self._paths.items() if path.get_subscription_count()}
        markers = self._markers.get_subscription_count() > 0
        if answer is None or not (watched or markers):
            self._drawn_version = 0
            return
        if answer.version == self._drawn_version:
            return
        self._drawn_version = answer.version
        trajectories = {robot: self._estimator.trajectory(answer, robot) for robot in self._settings.robots}
        for robot, path in watched.items():
            if (trajectory := trajectories[robot]) is not None:
                path.publish(path_message(trajectory, frame_id))
        if markers:
            known = [trajectory for trajectory in trajectories.values() if trajectory is not None]
            self._markers.publish(markers_message(answer, known, frame_id))

    def _reset(self) -> str:
        self._estimator.reset()
        return self._begin_anew("reset")

    def _solve_now(self) -> str:
        answer = self._tick(force_cold=True)
        if answer is None:
            return "nothing has changed since the last answer"
        return f"answer {answer.version}: {len(answer.keyframe_id)} keyframes, {int(answer.outlier.sum())} outliers"

    def _save(self) -> str:
        if self._state_file is None:
            raise UserError("the parameter state_file is empty; start the node with the file's name")
        self._estimator.save(self._state_file)
        return f"saved to {self._state_file}"

    def _resume(self, state_file: Path) -> None:
        if state_file.exists():
            self._estimator.load(state_file)
        elif not state_file.parent.is_dir():
            raise UserError(f"state_file is {state_file}, but there is no folder {state_file.parent}; make it first")

    def _load(self) -> str:
        if self._state_file is None:
            raise UserError("the parameter state_file is empty; start the node with the file's name")
        self._estimator.load(self._state_file)
        self._begin_anew("loaded")
        self._tick()
        return f"loaded {self._state_file}"

    def _begin_anew(self, what: str) -> str:
        """The published answers belong to what was forgotten: latch empty ones."""
        health, frame_id = self._health, self._settings.world_frame
        if health.answer is not None:
            nothing = health.answer.without_content()
            self._orientations.publish(orientations_message(nothing, frame_id))
            self._flags.publish(flags_message(nothing, frame_id))
        health.answer, health.unsolved_since = None, None
        return what

    # Services and timers

    async def _on_trigger(
        self, job: Callable[[], str], _request: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Do a job on the worker, without blocking the executor meanwhile."""
        try:
            response.message = await self._worker.submit(job)
            response.success = True
        except Exception as error:
            response.message = str(error)
            response.success = False
        return response

    def _on_pause(self, request: SetBool.Request, response: SetBool.Response) -> SetBool.Response:
        self._estimator.pause(request.data)
        self._health.unsolved_since = None
        response.success = True
        response.message = "paused: inputs are kept, nothing is solved" if request.data else "running"
        return response

    def _on_label_edge(self, request: LabelEdge.Request, response: LabelEdge.Response) -> LabelEdge.Response:
        robot = request.source_robot or self._settings.robots[0]
        try:
            label = EdgeLabel(request.label)
        except ValueError:
            response.success, response.message = False, f"label {request.label} is none of 0, 1, 2"
            return response
        number = self._estimator.label_edge(robot, request.edge_id, label)
        response.success = number > 0
        edges = f"edge {request.edge_id} of {robot}"
        response.message = f"{edges}: {label.name.lower()} ({number} found)" if number else f"{edges} is not known"
        return response

    def _on_diagnostics_timer(self) -> None:
        status = self._reporter.report(self._health, self._estimator.counts(), self._settings, self._estimator.paused)
        message = DiagnosticArray(status=[status])
        message.header.stamp = self.get_clock().now().to_msg()
        self._diagnostics.publish(message)
        self._worker.submit(self._draw_quietly)

    def _draw_quietly(self) -> None:
        try:
            self._draw()
        except Exception as error:
            self.get_logger().error(f"drawing failed: {error}", throttle_duration_sec=_LOG_PERIOD_S)

    def _on_autosave_timer(self) -> None:
        self._worker.submit(self._autosave)

    def _autosave(self) -> None:
        revision = self._estimator.revision
        if revision == self._saved_revision:
            return
        try:
            self._save()
            self._saved_revision = revision
        except Exception as error:
            self.get_logger().error(str(error), throttle_duration_sec=_LOG_PERIOD_S)
