"""The robots' present poses at odometry's rate: ``corrected_odometry``, and the odometry frames on ``/tf``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from geometry_msgs.msg import Point
from nav_msgs.msg import Odometry
from numpy.typing import NDArray
from rclpy.node import Node
from rclpy.qos import QoSProfile

from rotavg_ros.inputs import OdometryRecord
from rotavg_ros.online import OnlineEstimator, quaternion
from rotavg_ros.online.answer.gradual import CorrectionRates, GradualFrame
from rotavg_ros.online.answer.odometry_frame import OdometryFrame
from rotavg_ros.online.quaternion import Vector
from rotavg_ros.ros.node.output.conversions import to_quaternion_message
from rotavg_ros.ros.node.output.frame_correction import FrameCorrection
from rotavg_ros.ros.node.topics import publisher
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.stamps import NANOSECONDS

# Variance of unknown quantities, in rad² or m², or these per s²: large enough that a filter practically ignores them.
UNKNOWN_VARIANCE = 1e6
# The diagonal of a pose's 6 × 6 covariance: position, then orientation, about x, y, z of the world's frame.
_DIAGONAL = slice(None, None, 7)


class RobotPoses:
    """Publishes a pose for every odometry message with a position, corrected by the last placed answer.

    Attributes:
        are_placed: whether the last answer that was drawn has been placed. Nobody places one while nobody wants poses;
            who comes then gets none until it is, since the last one placed may be hours old.

    Raises:
        UserError: a topic's ``qos_overrides`` are invalid, or ``publish_tf`` without tf2_msgs.
    """

    def __init__(
        self, node: Node, parameters: NodeParameters, estimator: OnlineEstimator, prefix: Mapping[str, str]
    ) -> None:
        """Advertise the topics; ``prefix`` holds the prefix of each robot's topics."""
        self._estimator = estimator
        self.are_placed = True  # until there is an answer, poses are odometry's own
        self._frame_id = parameters.world_frame
        self._publishers = {
            robot: publisher(node, Odometry, f"{prefix[robot]}corrected_odometry", QoSProfile(depth=10))
            for robot in parameters.robots
        }
        self._rates, self._gradual = _rates(parameters), dict[str, GradualFrame]()
        self._generation = estimator.generation
        tolerance_ns = round(parameters.transform_tolerance_s * NANOSECONDS)
        self._tf = FrameCorrection(node, self._frame_id, tolerance_ns) if parameters.publish_tf else None

    @property
    def topics(self) -> list[str]:
        """Full names of the topics with poses."""
        return [each.topic_name for each in self._publishers.values()]

    @property
    def are_wanted(self) -> bool:
        """Whether anybody uses the poses."""
        return self._tf is not None or any(each.get_subscription_count() for each in self._publishers.values())

    def set_parameters(self, parameters: NodeParameters) -> None:
        """Take over what may change while the node runs."""
        self._rates = _rates(parameters)
        for gradual in self._gradual.values():
            gradual.rates = self._rates

    def warnings(self) -> list[str]:
        """Present mistakes, a line each."""
        return [] if self._tf is None else self._tf.warnings()

    def publish(self, robot: str, topic: str, message: Any, record: OdometryRecord) -> None:
        """Publish the poses of the robot and of its odometry frame at its newest message, if that has a position.

        Args:
            robot: name of the robot.
            topic: the topic that the message came on.
            message: the odometry message.
            record: its content.
        """
        position = record.known_position
        placed = self._estimator.odometry_frame(robot) if position is not None else None
        is_asked_for = self._publishers[robot].get_subscription_count() > 0
        if placed is None or position is None or not self.are_placed or not (is_asked_for or self._tf is not None):
            return
        exact, steps = placed
        frame = self._gradual_frame(robot).follow(exact, record.stamp_ns, position)
        if self._tf is not None:
            self._tf.publish(robot, topic, message.header, frame)
        if is_asked_for:
            pose = _odometry_message(message, record, frame, position)
            pose.header.frame_id = self._frame_id
            pose.pose.covariance = covariance(exact, steps, position)
            self._publishers[robot].publish(pose)

    def _gradual_frame(self, robot: str) -> GradualFrame:
        """The robot's gradual frame; a new one, without a past, once everything was forgotten or replaced."""
        if self._generation != self._estimator.generation:
            self._generation = self._estimator.generation
            self._gradual.clear()
        return self._gradual.setdefault(robot, GradualFrame(self._rates))


def _rates(parameters: NodeParameters) -> CorrectionRates:
    return CorrectionRates(math.radians(parameters.correction_rate_deg_s), parameters.correction_rate_m_s)


def _odometry_message(message: Any, record: OdometryRecord, frame: OdometryFrame, position: Vector) -> Odometry:
    """The message with its pose in the world; its velocity, if known, is in the moving frame and stays as it is."""
    odometry = Odometry(child_frame_id=record.child_frame_id)
    odometry.header.stamp = message.header.stamp
    x, y, z = frame.place(position)
    odometry.pose.pose.position = Point(x=x, y=y, z=z)
    orientation = quaternion.normalize(quaternion.multiply(frame.orientation, record.world_from_sensor))
    odometry.pose.pose.orientation = to_quaternion_message(orientation)
    if isinstance(message, Odometry):
        odometry.twist = message.twist
    else:
        unknown = np.zeros(36)
        unknown[_DIAGONAL] = UNKNOWN_VARIANCE
        odometry.twist.covariance = unknown
    return odometry


def covariance(frame: OdometryFrame, steps: int, odometry_position: Vector) -> NDArray[np.float64]:
    """``(36,)`` covariance of a pose, row by row, without the correlation of position and orientation.

    Args:
        frame: the odometry frame according to the answer.
        steps: number of odometry steps since the frame's keyframe.
        odometry_position: of the body in the odometry frame, metres.

    A robot that turns about its z axis alone does not err about the others; on a slope these are not the world's.
    One that moves across its z axis alone does not err along it.
    """
    orientation, position = frame.variances_at(odometry_position, steps)
    turns = np.eye(3) if frame.axis is None else np.outer(frame.axis, frame.axis)
    shifts = np.eye(3) - turns if frame.is_planar else np.eye(3)
    spread = np.zeros((6, 6))
    spread[:3, :3], spread[3:, 3:] = _known(position) * shifts, _known(orientation) * turns
    return spread.ravel()


def _known(variance: float) -> float:
    return variance if math.isfinite(variance) else UNKNOWN_VARIANCE
