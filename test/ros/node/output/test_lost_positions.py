"""A tracker that loses its position (NaN) and finds it again: no pose is published in between, and none is spoilt."""

from __future__ import annotations

import math
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from nav_msgs.msg import Odometry
from std_msgs.msg import Header

from rotavg_ros.inputs.odometry import from_odometry
from rotavg_ros.online import EstimatorOptions, OnlineEstimator
from rotavg_ros.ros.node.output import robot_poses
from rotavg_ros.ros.node.output.robot_poses import RobotPoses
from rotavg_ros.settings.parameters import NodeParameters

IDENTITY = (0.0, 0.0, 0.0, 1.0)


def odometry(index: int, x: float) -> Odometry:
    message = Odometry(header=Header(stamp=Time(sec=1000 + index), frame_id="odom"), child_frame_id="base_link")
    message.pose.pose.position.x, message.pose.pose.orientation.w = x, 1.0
    return message


@pytest.mark.parametrize("lost", [math.nan, math.inf, -math.inf])
def test_a_lost_position_is_no_pose(monkeypatch: pytest.MonkeyPatch, lost: float) -> None:
    published: list[Odometry] = []
    listened = SimpleNamespace(publish=published.append, get_subscription_count=lambda: 1, topic_name="/pose")
    placed: list[float] = []
    tf = SimpleNamespace(publish=lambda robot, topic, header, frame: placed.append(frame.origin[0]))
    monkeypatch.setattr(robot_poses, "publisher", lambda *_: listened)
    monkeypatch.setattr(robot_poses, "FrameCorrection", lambda *_: tf)
    parameters = NodeParameters(correction_rate_m_s=0.1, publish_tf=True)
    estimator = OnlineEstimator(EstimatorOptions(), lambda *_, **__: None)
    poses = RobotPoses(SimpleNamespace(), parameters, estimator, {"robot": ""})
    for index, x in enumerate([0.0, 0.1, lost, 0.3, 0.4]):
        message = odometry(index, x)
        record = from_odometry(message, IDENTITY)
        # The estimator takes it: its orientation is as good as ever.
        assert estimator.add_odometry("robot", record.stamp_ns, record.world_from_body, record.position) is None
        poses.publish("robot", "/odom", message, record)
    assert [message.header.stamp.sec for message in published] == [1000, 1001, 1003, 1004]
    np.testing.assert_allclose([message.pose.pose.position.x for message in published], [0.0, 0.1, 0.3, 0.4])
    np.testing.assert_allclose(placed, np.zeros(4))
