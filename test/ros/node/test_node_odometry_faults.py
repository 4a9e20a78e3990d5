"""Odometry that lies about its time, goes wild, stops, or begins anew: over real DDS, what the node makes of it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rotavg_msgs.msg import KeyframeReference, RelativeRotation

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
RESTART, PAUSE = 40, 20  # message numbers
PAUSE_S = 30


def truth(index: int) -> Rotation:
    """world_from_body: the robot looks back when it is started again."""
    return Rotation.from_euler("zx", [150 + index, 5], degrees=True)


def quaternion(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def stamp(index: int) -> Time:
    return Time(sec=1000 + index // 10 + PAUSE_S * (index >= PAUSE), nanosec=index % 10 * 100_000_000)


def odometry(index: int) -> Odometry:
    message = Odometry()
    message.header.stamp = stamp(index)
    since = truth(RESTART).inv() * truth(index) if index >= RESTART else truth(index)
    message.pose.pose.orientation = quaternion(since)
    message.pose.pose.position.x = 0.2 * index if index < RESTART else 0.2 * (index - RESTART)
    return message


def stamped(message: Odometry, time: Time) -> Odometry:
    message.header.stamp = time
    return message


def between(a: Quaternion, b: Rotation) -> float:
    return float(np.degrees((Rotation.from_quat([a.x, a.y, a.z, a.w]).inv() * b).magnitude()))


@pytest.mark.large
def test_faults_of_odometry_make_no_false_edge(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    for index in range(RESTART):
        live_node.odometry.publish(odometry(index))  # with a pause that is none in the pose
        if index % 8 == 3:
            live_node.odometry.publish(stamped(odometry(index), Time(sec=2_000_000_000 - index)))
            live_node.odometry.publish(odometry(index))  # again
            live_node.odometry.publish(stamped(odometry(index), stamp(index - 2)))
        if index % 8 == 5:
            wild = stamped(odometry(index), Time(sec=stamp(index).sec, nanosec=stamp(index).nanosec + 50_000_000))
            wild.pose.pose.orientation = quaternion(Rotation.identity())
            live_node.odometry.publish(wild)
    live_node.spin_until(lambda: live_node.status["keyframes"] == str(RESTART))
    before = live_node.wait_for_silence()
    for reason in ("future_stamp", "repeated_stamp", "out_of_order_odometry", "odometry_jump"):
        assert live_node.status[f"dropped {reason}"] == "5", reason
    assert set(before.components) == {0} and live_node.status["edges"] == str(RESTART - 1)

    steered = live_node.orientations[-1].quaternion
    for index in range(RESTART, RESTART + 30):
        live_node.odometry.publish(odometry(index))
    live_node.spin_until(lambda: live_node.status["keyframes"] == str(RESTART + 29))
    after = live_node.wait_for_silence()
    assert live_node.status["dropped odometry_jump"] == "6" and live_node.status["components"] == "2"
    assert live_node.status["odometry restarts"] == "1"
    ids = np.asarray(after.keyframe_ids)
    flags = live_node.flags[-1]
    edges = {(source, target) for source, target in zip(flags.source_ids, flags.target_ids, strict=True)}
    assert (RESTART - 2, RESTART - 1) in edges and (RESTART - 1, RESTART) not in edges
    assert np.asarray(after.components)[np.argsort(ids)].tolist() == [0] * RESTART + [1] * 29
    # Where it was last, and turned by what the new odometry has turned since its first good message.
    q = steered
    goes_on = Rotation.from_quat([q.x, q.y, q.z, q.w]) * truth(RESTART + 1).inv() * truth(RESTART + 29)
    assert between(live_node.orientations[-1].quaternion, goes_on) < 0.01

    ends = (KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=stamp(index)) for index in (10, RESTART + 20))
    closure = RelativeRotation(id=1, kind=RelativeRotation.LOOP_CLOSURE)
    closure.source, closure.target = ends
    closure.rotation = quaternion(truth(10).inv() * truth(RESTART + 20))
    live_node.edges.publish(closure)
    live_node.spin_until(lambda: live_node.status["components"] == "1")
    assert live_node.status["joins"] == "1" and "2 pieces of robot's track are joined" in live_node.process.output
    live_node.odometry.publish(odometry(RESTART + 30))
    said = len(live_node.orientations)
    live_node.spin_until(lambda: len(live_node.orientations) > said)
    assert between(live_node.orientations[-1].quaternion, truth(RESTART + 30)) < 0.01
