"""A robot that drives round in a circle, over DDS: its corrected odometry and tf lie on the corrected path."""

from __future__ import annotations

import itertools
import json
import math
import sys

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion
from nav_msgs.msg import Odometry, Path
from rotavg_msgs.msg import KeyframeReference, RelativeRotation
from std_msgs.msg import Header

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, OnlineEstimator
from rotavg_ros.online import KeyframeReference as Moment
from rotavg_ros.ros.node.output.robot_poses import covariance

pytestmark = pytest.mark.ros

EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
LAP, LENGTH = 40, 120
TOLERANCE_S = 0.25

PLACES = """
import json, rclpy
from tf2_msgs.msg import TFMessage
rclpy.init()
node = rclpy.create_node("tf_listener")
def on_tf(message):
    for each in message.transforms:
        stamp, at, turn = each.header.stamp, each.transform.translation, each.transform.rotation
        place = [stamp.sec + 1e-9 * stamp.nanosec, [at.x, at.y, at.z], [turn.x, turn.y, turn.z, turn.w]]
        print(json.dumps(place), flush=True)
node.create_subscription(TFMessage, "/tf", on_tf, 1000)
rclpy.spin(node)
"""


class Circle:
    """True poses, and odometry that drifts, in a frame turned and moved against the world; a second a message."""

    def __init__(self) -> None:
        random = np.random.default_rng(0)
        angle = 2 * math.pi * np.arange(LENGTH) / LAP
        self.truth = Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
        self.position = np.stack((4 * np.cos(angle), 4 * np.sin(angle), 0 * angle), axis=1)
        steps = self.truth[:-1].inv() * self.truth[1:]
        ways = self.truth[:-1].inv().apply(np.diff(self.position, axis=0))
        odometry, at = [Rotation.from_rotvec([0, 0, 1.0])], [np.array([30.0, -7.0, 0.0])]
        for step, way, error in zip(steps, ways, random.normal(0, math.radians(0.5), LENGTH - 1), strict=True):
            at.append(at[-1] + odometry[-1].apply(way))
            odometry.append(odometry[-1] * step * Rotation.from_rotvec([0, 0, error]))
        self.odometry, self.odometry_position = Rotation.concatenate(odometry), np.array(at)

    def message(self, index: int) -> Odometry:
        header = Header(stamp=Time(sec=1000 + index), frame_id="odom")
        message = Odometry(header=header, child_frame_id="base_link")
        x, y, z, w = self.odometry[index].as_quat().tolist()
        message.pose.pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
        x, y, z = self.odometry_position[index].tolist()
        message.pose.pose.position = Point(x=x, y=y, z=z)
        message.twist.twist.linear.x = 0.5 + index
        return message

    def closure(self, target: int) -> RelativeRotation:
        source = target - LAP
        edge = RelativeRotation(id=target, kind=RelativeRotation.LOOP_CLOSURE)
        edge.source, edge.target = (
            KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=Time(sec=1000 + each)) for each in (source, target)
        )
        x, y, z, w = (self.truth[source].inv() * self.truth[target]).as_quat().tolist()
        edge.rotation = Quaternion(x=x, y=y, z=z, w=w)
        edge.translation = self.truth[source].inv().apply(self.position[target] - self.position[source]).tolist()
        return edge


def seconds(stamp: Time) -> float:
    return stamp.sec + 1e-9 * stamp.nanosec


def pose(message) -> tuple[Rotation, np.ndarray]:
    turn, at = message.orientation, message.position
    return Rotation.from_quat([turn.x, turn.y, turn.z, turn.w]), np.array([at.x, at.y, at.z])


def test_pose_and_tf_lie_on_the_corrected_path(foreign_packages, live_node, start_process) -> None:
    run, poses, paths = Circle(), [], []
    live_node.probe.create_subscription(Odometry, "/corrected_odometry", poses.append, 1000)
    live_node.probe.create_subscription(Path, "/corrected_path", paths.append, 10)
    live_node.start(*EVERY_MESSAGE, "publish_tf:=true", f"transform_tolerance_s:={TOLERANCE_S}")
    listener = start_process(sys.executable, "-c", PLACES)
    live_node.spin_until(lambda: bool(live_node.probe.get_subscriptions_info_by_topic("/tf")))
    sent = 0

    def first_heard() -> bool:  # until the node has found both who listen
        nonlocal sent
        live_node.odometry.publish(run.message(sent))
        sent += 1
        live_node.spin_for(0.2)
        return bool(poses) and bool(listener.output)

    live_node.spin_until(first_heard)
    assert sent < LAP
    # Before the first answer, odometry is as good as anything.
    first = poses[0]
    index = round(seconds(first.header.stamp)) - 1000
    np.testing.assert_allclose(pose(first.pose.pose)[1], run.odometry_position[index], atol=1e-9)
    closures = 0
    for index in range(sent, LENGTH - 1):
        live_node.odometry.publish(run.message(index))
        if index >= LAP and index % 3 == 0:
            live_node.edges.publish(run.closure(index))
            closures += 1
    live_node.wait_for_silence(closures)
    live_node.spin_until(lambda: bool(paths) and len(paths[-1].poses) == int(live_node.status["keyframes"]))
    path = paths[-1]
    # One more message goes by the last answer, and says where its odometry frame lies.
    live_node.odometry.publish(run.message(LENGTH - 1))
    live_node.spin_until(lambda: seconds(poses[-1].header.stamp) == 1000 + LENGTH - 1)
    last = poses[-1]
    assert (last.header.frame_id, last.child_frame_id) == ("map", "base_link")
    assert last.twist.twist.linear.x == pytest.approx(0.5 + LENGTH - 1)
    turn, at = pose(last.pose.pose)
    world_from_odometry = turn * run.odometry[-1].inv()
    origin = at - world_from_odometry.apply(run.odometry_position[-1])
    newest = path.poses[-1]
    index = round(seconds(newest.header.stamp)) - 1000
    expected_turn, expected_at = pose(newest.pose)
    assert np.linalg.norm(world_from_odometry.apply(run.odometry_position[index]) + origin - expected_at) < 0.01
    assert np.degrees((expected_turn.inv() * world_from_odometry * run.odometry[index]).magnitude()) < 0.01
    # Odometry alone is far off by now; the path's own frame begins as odometry does.
    world = Rotation.from_rotvec([0, 0, 1.0])
    truth = np.array([30.0, -7.0, 0.0]) + world.apply(run.position[-1] - run.position[0])
    off = [float(np.linalg.norm(each - truth)) for each in (at, run.odometry_position[-1])]
    assert off[0] < 0.4 * off[1]
    # Planar: two variances of position, one of yaw, and nothing else.
    stated = np.array(last.pose.covariance).reshape(6, 6)
    assert np.count_nonzero(stated) == 3 and (np.diag(stated)[[0, 1, 5]] > 0).all()
    assert stated[0, 0] == stated[1, 1] and off[0] < 5 * math.sqrt(stated[0, 0])

    def placed_last() -> list:
        """Stamp, translation and rotation; who listens may have been found later than who hears poses."""
        return json.loads(listener.output.splitlines()[-1])

    expected = 1000 + LENGTH - 1 + TOLERANCE_S
    live_node.spin_until(lambda: listener.output.endswith("\n") and placed_last()[0] == pytest.approx(expected))
    _, at, turn = placed_last()
    np.testing.assert_allclose(at, origin, atol=1e-6)
    assert (Rotation.from_quat(turn).inv() * world_from_odometry).magnitude() < 1e-6


@pytest.mark.large
def test_a_correction_is_spread_over_time(live_node) -> None:
    run, poses = Circle(), []
    live_node.probe.create_subscription(Odometry, "/corrected_odometry", poses.append, 1000)
    live_node.start(*EVERY_MESSAGE, "correction_rate_m_s:=0.01", "correction_rate_deg_s:=0.1")
    half, sent = LENGTH // 2, 0

    def first_heard() -> bool:
        nonlocal sent
        live_node.odometry.publish(run.message(sent))
        sent += 1
        live_node.spin_for(0.2)
        return bool(poses)

    live_node.spin_until(first_heard)
    for index in range(sent, half):
        live_node.odometry.publish(run.message(index))
        if index >= LAP:
            live_node.edges.publish(run.closure(index))
    live_node.wait_for_silence(half - max(sent, LAP))
    for index in range(half, LENGTH):
        live_node.odometry.publish(run.message(index))
    live_node.spin_until(lambda: seconds(poses[-1].header.stamp) == 1000 + LENGTH - 1)
    frames = []
    for message in poses:
        index = round(seconds(message.header.stamp)) - 1000
        turn, at = pose(message.pose.pose)
        turn = turn * run.odometry[index].inv()
        frames.append((index, turn, at))
    moved = 0.0
    for (before, old, last_at), (index, new, at) in itertools.pairwise(frames):
        elapsed = index - before
        assert np.degrees((old.inv() * new).magnitude()) < 0.1 * elapsed + 1e-6
        # Where the last correction would have put the body now.
        carried = last_at + old.apply(run.odometry_position[index] - run.odometry_position[before])
        moved += float(np.linalg.norm(at - carried))
        assert np.linalg.norm(at - carried) < 0.01 * elapsed + 1e-6
    assert moved > 0.05


@pytest.mark.parametrize(("slope", "climb"), [(0.0, 0.0), (0.4, 0.0), (0.0, 0.1)], ids=["plain", "slope", "ramp"])
def test_where_a_covariance_states_zero_there_is_no_error(slope: float, climb: float) -> None:
    """A robot that turns about its own z axis alone: on a slope it errs about two of the world's axes."""
    random = np.random.default_rng(1)
    angle = 2 * math.pi * np.arange(LENGTH) / LAP
    tilt = Rotation.from_euler("x", slope)
    truth = tilt * Rotation.from_rotvec(np.outer(angle, [0, 0, 1]))
    position = tilt.apply(np.stack((4 * np.cos(angle), 4 * np.sin(angle), climb * angle), axis=1))
    estimator = OnlineEstimator(EstimatorOptions(keyframe_angle=0, keyframe_distance=0))
    moved, at = truth[0], position[0]
    for index in range(LENGTH):
        if index:
            off = Rotation.from_rotvec([0, 0, random.normal(0, 0.01)])
            way = truth[index - 1].inv().apply(position[index] - position[index - 1])
            at = at + moved.apply(way + random.normal(0, 0.01, 3) * [1, 1, climb > 0])
            moved = moved * truth[index - 1].inv() * truth[index] * off
        assert estimator.add_odometry("r", (1 + index) * 10**9, moved.as_quat(), at) is None
    for target in range(LAP, LENGTH, 4):
        ends = [Moment("r", stamp_ns=(1 + end) * 10**9) for end in (target - LAP, target)]
        turn, way = truth[target - LAP].inv() * truth[target], position[target] - position[target - LAP]
        way = truth[target - LAP].inv().apply(way)
        assert estimator.add_edge(EdgeMeasurement.from_ros(target, *ends, turn.as_quat(), way)) is None
    answer = estimator.tick()
    path = estimator.place(answer)["r"]
    turned = (Rotation.from_quat(path.world_from_body[-1]) * truth[-1].inv()).as_rotvec()
    off = np.concatenate((path.position[-1] - position[-1], turned))
    frame, steps = estimator.odometry_frame("r")
    stated, axes = np.linalg.eigh(covariance(frame, steps, at).reshape(6, 6))
    is_none = stated < 1e-9 * stated.max()
    assert is_none.sum() == (2 if climb else 3)
    assert np.abs(off @ axes[:, is_none]).max() < 1e-6
    assert (np.abs(off @ axes[:, ~is_none]) < 5 * np.sqrt(stated[~is_none])).all()
