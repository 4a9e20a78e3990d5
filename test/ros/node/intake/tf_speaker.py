"""A program that says on /tf_static, as a robot_state_publisher does, how the camera given in its arguments sits.

A process of its own, because only it and the node it talks to see tf2_msgs. Arguments: the pose of the camera on the
mast, x y z qx qy qz qw; the mast stands straight, 1 m above base_link and turned by 180°.
"""

from __future__ import annotations

import sys

import rclpy
from geometry_msgs.msg import Quaternion, Transform, TransformStamped, Vector3
from rclpy.qos import DurabilityPolicy, QoSProfile
from std_msgs.msg import Header
from tf2_msgs.msg import TFMessage


def main() -> None:
    x, y, z, qx, qy, qz, qw = map(float, sys.argv[1:])
    on_mast = Transform(translation=Vector3(x=x, y=y, z=z), rotation=Quaternion(x=qx, y=qy, z=qz, w=qw))
    mast = Transform(translation=Vector3(z=1.0), rotation=Quaternion(z=1.0, w=0.0))
    rclpy.init()
    node = rclpy.create_node("tf_speaker")
    latched = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    publisher = node.create_publisher(TFMessage, "/tf_static", latched)
    publisher.publish(
        TFMessage(
            transforms=[
                TransformStamped(header=Header(frame_id="mast"), child_frame_id="camera", transform=on_mast),
                TransformStamped(header=Header(frame_id="base_link"), child_frame_id="mast", transform=mast),
            ]
        )
    )
    rclpy.spin(node)


if __name__ == "__main__":
    main()
