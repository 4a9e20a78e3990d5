"""What the node publishes: answers, pictures of them, and the present orientation."""

from __future__ import annotations

import time
from functools import partial
from typing import Any

from geometry_msgs.msg import QuaternionStamped
from nav_msgs.msg import Path
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations, OutlierFlags
from visualization_msgs.msg import MarkerArray

from rotavg_ros.inputs import OdometryRecord
from rotavg_ros.online import Answer, OnlineEstimator
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.ros.node.output.conversions import flags_message, orientations_message, to_quaternion_message
from rotavg_ros.ros.node.output.robot_poses import RobotPoses
from rotavg_ros.ros.node.output.visualization import markers_message, no_markers, no_path, path_message
from rotavg_ros.ros.node.topics import LATCHED, checked_prefixes, publisher
from rotavg_ros.settings.parameters import NodeParameters

# Pause for other work after a drawing, in multiples of its duration: half a second at 10 000 keyframes.
_REST = 4.0


class Outputs:
    """All publishers except that of the diagnostics.

    Raises:
        UserError: a robot's name cannot be part of a topic's, a topic's ``qos_overrides`` are invalid, or
            ``publish_tf`` without tf2_msgs.
    """

    def __init__(self, node: Node, parameters: NodeParameters, estimator: OnlineEstimator) -> None:
        self._estimator = estimator
        self._robots, self._frame_id = parameters.robots, parameters.world_frame
        # For each picture: version of the answer drawn, and number of subscribers then, less those gone since.
        self._drawn: dict[Publisher, tuple[int, int]] = {}
        self._rests_until = 0.0  # on the monotonic clock
        latched = partial(publisher, node, qos=LATCHED)
        self._orientations = latched(AbsoluteOrientations, "abs_orientations")
        self._flags = latched(OutlierFlags, "outlier_flags")
        self._markers = latched(MarkerArray, "~/markers")
        prefix = checked_prefixes(parameters.prefixes())
        self._robot_of_path = {latched(Path, f"{prefix[robot]}corrected_path"): robot for robot in self._robots}
        self._orientation = {
            robot: publisher(node, QuaternionStamped, f"{prefix[robot]}orientation", QoSProfile(depth=10))
            for robot in self._robots
        }
        self._poses = RobotPoses(node, parameters, estimator, prefix)
        self._placed: tuple[int, dict[str, Trajectory]] = (0, {})

    @property
    def exclusive_topics(self) -> list[str]:
        """Full names of topics that only one node should publish."""
        oriented = (each.topic_name for each in self._orientation.values())
        return [self._orientations.topic_name, *oriented, *self._poses.topics]

    def warnings(self) -> list[str]:
        """Present mistakes, a line each."""
        return self._poses.warnings()

    def set_parameters(self, parameters: NodeParameters) -> None:
        """Take over what may change while the node runs."""
        self._poses.set_parameters(parameters)

    def publish_answer(self, answer: Answer) -> None:
        """Latch the answer's keyframes and edges."""
        self._orientations.publish(orientations_message(answer, self._frame_id))
        self._flags.publish(flags_message(answer, self._frame_id))

    def draw(self, answer: Answer | None) -> None:
        """Publish paths and markers of the last answer if anybody subscribes, and again for new subscribers.

        From now on poses follow the answer, too. If there is no answer, since all was forgotten, drawings are erased
        and poses are odometry's own.

        Called at least once a second, so that drawings skipped to save time are made later.
        """
        if answer is None:
            self._erase()
            self._poses.are_placed = True
            return
        if self._poses.are_wanted:
            self._trajectories(answer)
        self._poses.are_placed = self._placed[0] == answer.version
        started = time.monotonic()
        if started < self._rests_until:
            return
        watchers = {picture: picture.get_subscription_count() for picture in (*self._robot_of_path, self._markers)}
        missing = [picture for picture, number in watchers.items() if self._lacks(picture, answer, number)]
        if not missing:
            return
        try:
            for picture in missing:
                picture.publish(self._picture(picture, answer))
                self._drawn[picture] = answer.version, watchers[picture]
        finally:
            ended = time.monotonic()
            self._rests_until = ended + _REST * (ended - started)

    def _picture(self, picture: Publisher, answer: Answer) -> Path | MarkerArray:
        trajectories = self._trajectories(answer)
        if picture is self._markers:
            return markers_message(answer, list(trajectories.values()), self._frame_id)
        drawn = trajectories.get(self._robot_of_path[picture])
        return no_path(self._frame_id) if drawn is None else path_message(drawn, self._frame_id)

    def _erase(self) -> None:
        for picture in self._drawn:
            picture.publish((no_markers if picture is self._markers else no_path)(self._frame_id))
        self._drawn.clear()

    def _trajectories(self, answer: Answer) -> dict[str, Trajectory]:
        """Trajectories of the answer, which poses follow from now on."""
        if self._placed[0] != answer.version:
            self._placed = answer.version, self._estimator.place(answer)
        return self._placed[1]

    def _lacks(self, picture: Publisher, answer: Answer, watchers: int) -> bool:
        """Whether some of the picture's subscribers (``watchers`` in number) have not been sent this answer yet."""
        version, watchers_then = self._drawn.get(picture, (0, 0))
        if watchers < watchers_then:
            self._drawn[picture] = version, watchers
        return watchers > 0 and (version != answer.version or watchers > watchers_then)

    def publish_odometry(self, robot: str, topic: str, message: Any, record: OdometryRecord) -> None:
        """Publish the robot's corrected orientation and pose at the moment of its newest odometry message.

        Args:
            robot: name of the robot.
            topic: the topic that the message came on.
            message: the odometry message.
            record: its content.
        """
        orientation = self._estimator.current_orientation(robot)
        if orientation is None:
            return
        stamped = QuaternionStamped(quaternion=to_quaternion_message(orientation))
        stamped.header.stamp = message.header.stamp
        stamped.header.frame_id = self._frame_id
        self._orientation[robot].publish(stamped)
        self._poses.publish(robot, topic, message, record)
