"""Who asks for poses after hours gets none of hours ago: poses are not placed while nobody wants them."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion
from nav_msgs.msg import Odometry

from rotavg_ros.inputs.odometry import from_odometry
from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.quaternion import IDENTITY
from rotavg_ros.ros.node.output import outputs, robot_poses
from rotavg_ros.settings.parameters import NodeParameters

LAP, LENGTH = 12, 49
TRUTH = Rotation.from_rotvec(np.outer(np.arange(LENGTH), [0, 0, 2 * np.pi / LAP]))
_STEP_ERRORS = np.random.default_rng(0).normal(np.radians(2), np.radians(1), LENGTH)
ODOMETRY = TRUTH * Rotation.from_rotvec(np.outer(np.cumsum(_STEP_ERRORS), [0, 0, 1]))


@dataclass(eq=False)
class Output:
    get_subscription_count: Callable[[], int]
    publish: Callable[[object], None]


def message(index: int) -> Odometry:
    odometry = Odometry(child_frame_id="base_link")
    odometry.header.stamp = Time(sec=1000 + index)
    x, y, z, w = ODOMETRY[index].as_quat().tolist()
    odometry.pose.pose.orientation, odometry.pose.pose.position = Quaternion(x=x, y=y, z=z, w=w), Point()
    return odometry


def test_a_late_listener_gets_poses_by_the_last_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    listeners, published = 0, []

    def publisher(_node: object, _type: type, topic: str, qos: object) -> Output:
        if topic != "corrected_odometry":
            return Output(lambda: 0, lambda _: None)
        return Output(lambda: listeners, published.append)

    monkeypatch.setattr(outputs, "publisher", publisher)
    monkeypatch.setattr(robot_poses, "publisher", publisher)
    parameters = NodeParameters(correction_rate_deg_s=0.1, correction_rate_m_s=0.1)
    estimator = OnlineEstimator(EstimatorOptions(keyframe_angle=0.0, keyframe_distance=0.0))
    node = outputs.Outputs(SimpleNamespace(), parameters, estimator)

    def send(index: int) -> None:
        record = from_odometry(message(index), IDENTITY)
        assert estimator.add_odometry("robot", record.stamp_ns, record.world_from_body, record.position) is None
        node.publish_odometry("robot", "/odom", message(index), record)

    for index in range(LENGTH - 2):
        send(index)
    for index in range(LAP, LENGTH - 2):
        ends = (KeyframeReference("robot", each) for each in (index - LAP, index))
        estimator.add_edge(EdgeMeasurement.from_ros(index, *ends, (0.0, 0.0, 0.0, 1.0)))
    answer = estimator.tick(force_cold=True)
    node.draw(answer)
    listeners = 1
    send(LENGTH - 2)
    assert published == []
    node.draw(answer)
    send(LENGTH - 1)
    (pose,) = published
    turn = pose.pose.pose.orientation
    found, newest = Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]), LENGTH - 3  # of the answer's keyframes
    expected = Rotation.from_quat(answer.world_from_body[newest]) * ODOMETRY[newest].inv() * ODOMETRY[-1]
    assert (expected.inv() * found).magnitude() < 1e-6 and pose.pose.covariance[35] < np.radians(10) ** 2
    assert (ODOMETRY[-1].inv() * found).magnitude() > np.radians(45)  # odometry has drifted by 103°
