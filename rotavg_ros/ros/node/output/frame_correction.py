"""The transform from the world frame to a robot's odometry frame, published on request (``publish_tf``)."""

from __future__ import annotations

from geometry_msgs.msg import TransformStamped, Vector3
from rclpy.node import Node
from rclpy.qos import QoSProfile
from std_msgs.msg import Header

from rotavg_ros.errors import UserError
from rotavg_ros.inputs.fields import to_nanoseconds
from rotavg_ros.online.answer.odometry_frame import OdometryFrame
from rotavg_ros.ros.node.output.conversions import to_quaternion_message, to_time
from rotavg_ros.ros.node.topics import publisher


class FrameCorrection:
    """Publishes on ``/tf``, but not for a robot whose odometry has no frame that could be placed.

    Raises:
        UserError: tf2_msgs is not installed, or a topic's ``qos_overrides`` are invalid.
    """

    def __init__(self, node: Node, world_frame: str, tolerance_ns: int) -> None:
        """Get ready to publish.

        Args:
            node: the node.
            world_frame: name of the parent frame.
            tolerance_ns: how far ahead transforms are dated, so that they are available for the next odometry message.
        """
        try:
            from tf2_msgs.msg import TFMessage  # type: ignore[import-not-found]
        except ImportError as error:
            raise UserError("publish_tf needs tf2_msgs: install that package or leave publish_tf off") from error
        self._message_type, self._world_frame, self._tolerance_ns = TFMessage, world_frame, tolerance_ns
        self._publisher = publisher(node, TFMessage, "/tf", QoSProfile(depth=100))
        self._placed: dict[str, str] = {}  # the frame of each robot's odometry that was placed last
        self._mistakes: dict[str, str] = {}

    def publish(self, robot: str, topic: str, odometry: Header, frame: OdometryFrame) -> None:
        """Place the frame of a robot's odometry message, which came on ``topic`` and has this header."""
        mistake = self._mistake(robot, odometry.frame_id)
        if mistake is not None:
            self._mistakes[topic] = f"publish_tf says nothing about {topic}: {mistake}"
            return
        self._mistakes.pop(topic, None)
        self._placed[robot] = odometry.frame_id
        stamp = to_time(to_nanoseconds(odometry.stamp) + self._tolerance_ns)
        header = Header(stamp=stamp, frame_id=self._world_frame)
        transform = TransformStamped(header=header, child_frame_id=odometry.frame_id)
        x, y, z = frame.origin
        transform.transform.translation = Vector3(x=x, y=y, z=z)
        transform.transform.rotation = to_quaternion_message(frame.orientation)
        self._publisher.publish(self._message_type(transforms=[transform]))

    def warnings(self) -> list[str]:
        """Present mistakes, a line each."""
        return list(self._mistakes.values())

    def _mistake(self, robot: str, frame: str) -> str | None:
        """Why a frame cannot be placed; None if it can."""
        if not frame:
            return "its header.frame_id is empty; have the driver name the odometry frame"
        if frame.startswith("/"):
            return f"tf2 takes no frame that begins with '/', as {frame} does; have the driver leave that out"
        if frame == self._world_frame:
            return f"it is in the world frame {frame} already; set world_frame to another one, or feed the raw odometry"
        for other, placed in self._placed.items():
            if other != robot and placed == frame:
                return f"{other} has the odometry frame {frame}, too; give each robot a frame of its own"
        return None
