"""The node over real DDS: what goes in, what comes out, and when nothing does."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion, QuaternionStamped
from nav_msgs.msg import Odometry, Path
from rclpy.qos import DurabilityPolicy, QoSProfile
from rotavg_msgs.msg import AbsoluteOrientations, KeyframeReference, RelativeRotation, RelativeRotationArray
from visualization_msgs.msg import Marker, MarkerArray

pytestmark = pytest.mark.ros

LATCHED = QoSProfile(depth=1, durability=DurabilityPolicy.TRANSIENT_LOCAL)
EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=0.1")
LENGTH = 60


def quaternion(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def truth(index: int) -> Rotation:
    """world_from_body: two laps around a square block, on a slope."""
    return Rotation.from_euler("zx", [12.0 * index, 5.0], degrees=True)


# Odometry errs by a degree a step, in a drawing that ten closures decide.
DRIFT_DEG = 40 + np.cumsum(np.random.default_rng(8).normal(0, 1, 2 * LENGTH))


def drifting(index: int) -> Rotation:
    """What odometry makes of it."""
    return Rotation.from_euler("zx", [12.0 * index + DRIFT_DEG[index], 5.0], degrees=True)


def stamp(index: int) -> Time:
    return Time(sec=1_700_000_000 + index // 10, nanosec=index % 10 * 100_000_000)


def odometry(index: int, rotation: Rotation | None = None) -> Odometry:
    message = Odometry()
    message.header.stamp = stamp(index)
    message.header.frame_id = "odom"
    message.pose.pose.position.x = 0.1 * index
    message.pose.pose.orientation = quaternion(drifting(index) if rotation is None else rotation)
    return message


def closure(edge_id: int, source: int, target: int, rotation: Rotation | None = None) -> RelativeRotation:
    """The true orientation of the target in the source frame, by stamp."""
    ends = [KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=stamp(index)) for index in (source, target)]
    return RelativeRotation(
        id=edge_id,
        sequence=edge_id,
        source=ends[0],
        target=ends[1],
        rotation=quaternion(truth(source).inv() * truth(target) if rotation is None else rotation),
        kind=RelativeRotation.LOOP_CLOSURE,
    )


def orientations(message: AbsoluteOrientations) -> Rotation:
    return Rotation.from_quat(np.array(message.orientations).reshape(-1, 4))


def feed(live_node, start: int = 0, stop: int = LENGTH, closures: bool = True) -> None:
    """Odometry, and a true closure to half a lap, a lap before at every third keyframe."""
    for index in range(start, stop):
        live_node.odometry.publish(odometry(index))
        if closures and index >= 30 and index % 3 == 0:
            live_node.edges.publish(closure(index // 3 - 9, index - 30, index))


def errors_deg(message: AbsoluteOrientations) -> np.ndarray:
    """Against truth, in the gauge of the first keyframe."""
    ours = orientations(message)
    theirs = Rotation.concatenate([truth(index) for index in range(len(ours))])
    return np.degrees(((ours[0].inv() * ours).inv() * (theirs[0].inv() * theirs)).magnitude())


def test_drift_is_corrected_and_the_false_closure_flagged(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node)
    false = Rotation.from_rotvec([0, 1.5, 0])
    live_node.edges.publish(closure(11, 20, 58, false))
    answer = live_node.wait_for_silence()
    assert answer.robots == ["robot"] and answer.header.frame_id == "map"
    assert list(answer.keyframe_ids) == list(range(LENGTH))
    assert list(answer.stamps_ns) == [1_700_000_000_000_000_000 + 100_000_000 * index for index in range(LENGTH)]
    assert set(answer.components) == {0} and set(answer.keyframe_robots) == {0}
    assert answer.header.stamp == stamp(LENGTH - 1)
    odometry_error = np.abs(DRIFT_DEG[:LENGTH] - DRIFT_DEG[0])
    assert errors_deg(answer).mean() < 0.5 * odometry_error.mean()
    first = drifting(0).as_quat(canonical=True)
    np.testing.assert_allclose(orientations(answer)[0].as_quat(canonical=True), first, atol=1e-9)
    assert np.isfinite(answer.uncertainties_deg).all()
    flags = live_node.flags[-1]
    closures = np.array(flags.kinds) == RelativeRotation.LOOP_CLOSURE
    assert closures.sum() == 11
    by_id = dict(zip(np.array(flags.edge_ids)[closures].tolist(), np.array(flags.outliers)[closures], strict=True))
    assert [edge_id for edge_id, outlier in by_id.items() if outlier] == [11]
    odometry_ids = np.array(flags.edge_ids)[~closures]
    assert set(odometry_ids.tolist()) == {2**64 - 1} and len(odometry_ids) == LENGTH - 1
    last = closures.nonzero()[0][-1]
    assert (flags.source_ids[last], flags.target_ids[last]) == (20, 58)
    assert live_node.status["outliers"] == "1" and live_node.status["lost messages"] == "0"
    assert live_node.status["name"] == "rotavg: estimator"


def test_a_late_subscriber_gets_the_whole_answer(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node)
    answer = live_node.wait_for_silence()
    late: list[AbsoluteOrientations] = []
    live_node.probe.create_subscription(AbsoluteOrientations, "/abs_orientations", late.append, LATCHED)
    live_node.spin_until(lambda: bool(late))
    assert late[0] == answer


def test_orientation_on_every_odometry_message(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    live_node.spin_until(lambda: live_node.odometry.get_subscription_count() > 0)
    feed(live_node)
    live_node.spin_until(lambda: len(live_node.orientations) == LENGTH)
    assert [message.header.stamp for message in live_node.orientations] == [stamp(index) for index in range(LENGTH)]
    answer = live_node.wait_for_silence()
    ahead = LENGTH + 1
    live_node.odometry.publish(odometry(ahead))
    live_node.spin_until(lambda: len(live_node.orientations) == LENGTH + 1)
    now = live_node.orientations[-1]
    expected = orientations(answer)[-1] * drifting(LENGTH - 1).inv() * drifting(ahead)
    published = Rotation.from_quat([now.quaternion.x, now.quaternion.y, now.quaternion.z, now.quaternion.w])
    assert np.degrees((published.inv() * expected).magnitude()) < 1e-6
    assert now.header.frame_id == "map"


@pytest.mark.large
def test_nothing_is_recomputed_when_nothing_changed(live_node) -> None:
    live_node.start("keyframe_angle_deg:=10.0", "solve_period_s:=0.05")
    feed(live_node)
    live_node.wait_for_silence()
    version, number = live_node.status["answer version"], len(live_node.answers)
    for index in range(LENGTH, LENGTH + 20):  # odometry of a robot that stands still makes no keyframe
        still = odometry(index, drifting(LENGTH - 1))
        still.pose.pose.position.x = 0.1 * (LENGTH - 1)
        live_node.odometry.publish(still)
    live_node.edges.publish(closure(1, 0, 30))  # a retransmission
    live_node.status.clear()
    live_node.spin_until(lambda: live_node.status.get("odometry messages") == str(LENGTH + 20))
    live_node.spin_for(1.0)
    assert live_node.status["answer version"] == version and len(live_node.answers) == number
    assert live_node.status["dropped duplicate_edge"] == "1"


@pytest.mark.large
def test_the_gauge_stays(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "gauge:=identity")
    for start in range(0, LENGTH, 10):
        feed(live_node, start, start + 10)
        live_node.spin_for(0.4)
    live_node.wait_for_silence()
    assert len(live_node.answers) > 3
    for answer in live_node.answers:
        np.testing.assert_allclose(np.array(answer.orientations[:4]), [0, 0, 0, 1], atol=1e-12)


def test_an_array_of_thousands_of_edges_arrives_whole(live_node) -> None:
    live_node.start("keyframe_source:=edges", "solve_period_s:=0.1")
    chain, length = [], 3000  # in many packets: a megabyte
    for index in range(length):
        edge = closure(index, index, index + 1, Rotation.from_rotvec([0, 0, 0.01]))
        edge.kind = RelativeRotation.ODOMETRY
        for end, node in ((edge.source, index), (edge.target, index + 1)):
            end.by, end.id = KeyframeReference.BY_ID, node
        chain.append(edge)
    live_node.arrays.publish(RelativeRotationArray(edges=chain))
    answer = live_node.wait_for_silence()
    assert list(answer.keyframe_ids) == list(range(length + 1))
    turned = np.degrees((orientations(answer)[0].inv() * orientations(answer)[100]).magnitude())
    assert turned == pytest.approx(np.degrees(1.0))


@pytest.mark.large
def test_path_and_markers_for_those_who_look(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node)
    answer = live_node.wait_for_silence()
    paths: list[Path] = []
    markers: list[MarkerArray] = []
    live_node.probe.create_subscription(Path, "/corrected_path", paths.append, 10)
    live_node.spin_until(lambda: bool(paths))
    # Who begins to look later, at something else, is shown it as well.
    live_node.probe.create_subscription(MarkerArray, "/rotavg/markers", markers.append, 10)
    live_node.spin_until(lambda: bool(markers))
    assert len(paths[0].poses) == LENGTH and paths[0].header.frame_id == "map"
    x, y, z, w = answer.orientations[-4:]
    assert paths[0].poses[-1].pose.orientation == Quaternion(x=x, y=y, z=z, w=w)
    spheres, lines = markers[0].markers
    assert spheres.type == Marker.SPHERE_LIST and len(spheres.points) == LENGTH
    assert lines.type == Marker.LINE_LIST and len(lines.points) == len(lines.colors) == 2 * (LENGTH - 1 + 10)
    # What was drawn of a graph that is forgotten is taken back.
    assert live_node.call("reset").success
    live_node.spin_until(lambda: not paths[-1].poses and len(markers[-1].markers) == 1)
    assert markers[-1].markers[0].action == Marker.DELETEALL and paths[-1].header.frame_id == "map"


@pytest.mark.large
def test_it_works_with_simulated_time_and_no_clock(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "use_sim_time:=true")
    feed(live_node)
    assert len(live_node.wait_for_silence().keyframe_ids) == LENGTH


@pytest.mark.large
def test_lost_messages_are_counted_by_the_senders_sequence(live_node) -> None:
    live_node.start(*EVERY_MESSAGE)
    feed(live_node, closures=False)
    for sequence in (1, 2, 5, 6, 9):
        edge = closure(sequence, sequence, sequence + 30)
        edge.sequence = sequence
        live_node.edges.publish(edge)
    live_node.wait_for_silence()
    assert live_node.status["lost by sequence"] == "4" and live_node.status["lost messages"] == "4"
    assert live_node.status["edge messages"] == "5"


@pytest.mark.large
def test_a_clean_end_in_the_middle_of_the_stream(live_node) -> None:
    live_node.start(*EVERY_MESSAGE, "solve_period_s:=0.01")
    feed(live_node)
    live_node.spin_for(0.1)
    assert live_node.stop(signal.SIGTERM) == 0
    assert "Traceback" not in live_node.process.output


def test_several_robots_keep_apart_until_they_meet(live_node) -> None:
    robots = ("robots:=[a, b]", "odometry_topics:=[odom, odom_b]", "solve_period_s:=0.1")
    live_node.start(*EVERY_MESSAGE[:2], *robots, "qos_overrides./odom_b.subscription.reliability:=reliable")
    second = live_node.probe.create_publisher(Odometry, "/odom_b", 1000)
    live_node.spin_until(lambda: second.get_subscription_count() > 0)
    for index in range(20):
        live_node.odometry.publish(odometry(index))
        second.publish(odometry(index, Rotation.from_euler("z", 3.0 * index, degrees=True)))
    live_node.spin_until(lambda: live_node.status.get("keyframes") == "40")
    apart = live_node.wait_for_silence()
    assert sorted(set(apart.components)) == [0, 1] and sorted(apart.robots) == ["a", "b"]
    assert "2 components" in live_node.status["message"] and live_node.status["level"] == "1"
    bridge = closure(1, 5, 6)
    bridge.source.robot, bridge.target.robot = "a", "b"
    live_node.edges.publish(bridge)
    live_node.spin_until(lambda: live_node.status.get("components") == "1")
    joined = live_node.wait_for_silence()
    older = np.array(apart.components) == 0
    np.testing.assert_allclose(
        np.array(joined.orientations).reshape(-1, 4)[older],
        np.array(apart.orientations).reshape(-1, 4)[older],
        atol=1e-9,
    )
    assert "a and b are joined (all one)" in live_node.process.output
    # What the robots steer by is in one frame from the next message on.
    heard: dict[str, list[QuaternionStamped]] = {"a": [], "b": []}
    for robot, messages in heard.items():
        live_node.probe.create_subscription(QuaternionStamped, f"/{robot}/orientation", messages.append, 10)
    live_node.spin_until(lambda: all(live_node.probe.count_publishers(f"/{robot}/orientation") for robot in heard))
    for index in range(20, 320):  # until the node has found who listens
        live_node.odometry.publish(odometry(index))
        second.publish(odometry(index, Rotation.from_euler("z", 3.0 * index, degrees=True)))
        live_node.spin_for(0.2)
        if all(told and told[-1].header.stamp == stamp(index) for told in heard.values()):
            break
    else:
        pytest.fail("nobody heard of both robots")
    a, b = (Rotation.from_quat([q.x, q.y, q.z, q.w]) for q in (messages[-1].quaternion for messages in heard.values()))
    turned = Rotation.from_euler("z", 3.0 * (index - 6), degrees=True)
    expected = drifting(index).inv() * drifting(5) * (truth(5).inv() * truth(6)) * turned
    assert np.degrees(((a.inv() * b).inv() * expected).magnitude()) < 0.01
