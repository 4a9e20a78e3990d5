"""Edges measured between cameras, over DDS: taken into the body's frame by /tf_static, before and after it comes."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, Quaternion
from nav_msgs.msg import Odometry
from rclpy.executors import SingleThreadedExecutor
from rclpy.qos import QoSProfile
from rotavg_msgs.msg import KeyframeReference, RelativeRotation
from std_msgs.msg import Empty, Header

from rotavg_ros.inputs import EdgeRecord
from rotavg_ros.online import EdgeMeasurement
from rotavg_ros.online import KeyframeReference as Reference
from rotavg_ros.ros.node.intake import edge_frames
from rotavg_ros.ros.node.intake.wiring import Input

pytestmark = pytest.mark.ros

SPEAKER = Path(__file__).with_name("tf_speaker.py")
# A period that no solve exceeds on a busy machine, which would be warned of for a minute.
EVERY_MESSAGE = ("keyframe_angle_deg:=0.0", "keyframe_distance_m:=0.0", "solve_period_s:=1.0")
PATIENT = "odometry_timeout_s:=1000.0"
SECONDS = 12
CAMERAS = {
    "about z": Rotation.from_euler("z", 90, degrees=True),
    "about x": Rotation.from_euler("x", 90, degrees=True),
}
LEVER = np.array([0.4, -0.2, 0.1])
MAST = Rotation.from_euler("z", 180, degrees=True)


def pose(second: int) -> tuple[Rotation, np.ndarray]:
    """The body on two laps of a ramp that winds up: no two axes of turns are the same."""
    heading = 60 * second
    here = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.1 * second])
    return Rotation.from_euler("zx", [heading + 90, 10 + 3 * second], degrees=True), 2 * here


def camera_pose(second: int, camera: Rotation) -> tuple[Rotation, np.ndarray]:
    body, here = pose(second)
    return body * MAST * camera, here + body.apply([0, 0, 1]) + (body * MAST).apply(LEVER)


def xyzw(rotation: Rotation) -> Quaternion:
    x, y, z, w = rotation.as_quat().tolist()
    return Quaternion(x=x, y=y, z=z, w=w)


def odometry(second: int) -> Odometry:
    body, here = pose(second)
    x, y, z = here.tolist()
    message = Odometry(header=Header(stamp=Time(sec=1000 + second), frame_id="odom"), child_frame_id="base_link")
    message.pose.pose.orientation, message.pose.pose.position = xyzw(body), Point(x=x, y=y, z=z)
    return message


def closure(number: int, source: int, camera: Rotation, frame: str = "camera") -> RelativeRotation:
    """From a second to the one a lap later, between poses of the camera."""
    (start, start_position), (end, end_position) = camera_pose(source, camera), camera_pose(source + 6, camera)
    ends = [
        KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=Time(sec=1000 + second))
        for second in (source, source + 6)
    ]
    return RelativeRotation(
        header=Header(frame_id=frame),
        id=number,
        source=ends[0],
        target=ends[1],
        rotation=xyzw(start.inv() * end),
        translation=start.inv().apply(end_position - start_position).tolist(),
        precision=0.0,
        kind=RelativeRotation.LOOP_CLOSURE,
    )


def mounted(camera: Rotation) -> list[str]:
    return [repr(number) for number in (*LEVER.tolist(), *camera.as_quat().tolist())]


def residuals(live_node, number: int) -> tuple[float, float]:
    """Degrees and metres, of the edge with an id."""
    flags = live_node.flags[-1]
    place = list(flags.edge_ids).index(number)
    return flags.residuals_deg[place], flags.residuals_m[place]


@pytest.mark.parametrize(
    "camera",
    [pytest.param(CAMERAS["about z"], marks=pytest.mark.large), CAMERAS["about x"]],
    ids=["about z", "about x"],
)
def test_edges_of_a_camera_before_and_after_its_transform(
    foreign_packages, live_node, start_process, camera: Rotation
) -> None:
    live_node.start(*EVERY_MESSAGE, PATIENT, "edge_frame_wait_s:=1000.0")
    for number in range(3):
        live_node.edges.publish(closure(number, number, camera))
    live_node.spin_until(lambda: live_node.status.get("waiting for frames") == "3")
    for second in range(SECONDS):
        live_node.odometry.publish(odometry(second))
    live_node.spin_until(lambda: live_node.status["edges"] == str(SECONDS - 1))
    assert live_node.status["waiting for frames"] == "3" and live_node.status["pending"] == "0"
    start_process(sys.executable, SPEAKER, *mounted(camera))
    live_node.spin_until(lambda: live_node.status["edges"] == str(SECONDS + 2))
    live_node.edges.publish(closure(3, 3, camera))
    live_node.spin_until(lambda: live_node.status["edges"] == str(SECONDS + 3))
    live_node.wait_for_silence()
    live_node.spin_until(lambda: len(live_node.flags[-1].edge_ids) == SECONDS + 3)
    for number in range(4):
        degrees, metres = residuals(live_node, number)
        assert degrees < 1e-3 and metres < 1e-3, number
    live_node.said.clear()
    live_node.spin_until(lambda: any(said == (0, "ok") for said in live_node.said))
    assert live_node.status["waiting for frames"] == "0"


@pytest.mark.large
def test_a_camera_that_nobody_places(foreign_packages, live_node, start_process) -> None:
    """Its edges are taken as they are, with a warning; when its transform comes after all, it counts from then on."""
    camera = CAMERAS["about x"]
    live_node.start(*EVERY_MESSAGE, PATIENT, "edge_frame_wait_s:=0.5")
    for second in range(SECONDS):
        live_node.odometry.publish(odometry(second))
    live_node.edges.publish(closure(0, 0, camera))
    live_node.spin_until(lambda: live_node.status["edges"] == str(SECONDS))
    live_node.said.clear()
    live_node.spin_until(lambda: any("/relative_rotations is in frame camera" in said for _, said in live_node.said))
    assert "edge_sensor_orientations" in live_node.status["message"] and "/tf_static" in live_node.status["message"]
    said = "nothing has said how frame camera sits on the body of robot"
    assert said in live_node.process.output and "publish it on /tf_static" in live_node.process.output
    start_process(sys.executable, SPEAKER, *mounted(camera))
    live_node.spin_until(lambda: live_node.probe.count_publishers("/tf_static") > 0)

    def placed() -> bool:
        number = placed.sent = placed.sent + 1
        live_node.edges.publish(closure(number, number % 6, camera))
        live_node.spin_for(0.5)
        return "the transform of camera is known now" in live_node.process.output

    placed.sent = 0
    live_node.spin_until(placed)
    live_node.edges.publish(closure(1000, 4, camera))
    live_node.spin_until(lambda: 1000 in live_node.flags[-1].edge_ids)
    live_node.wait_for_silence()
    assert residuals(live_node, 1000)[0] < residuals(live_node, 0)[0]
    live_node.said.clear()
    live_node.spin_until(lambda: any("is in frame camera" not in said for _, said in live_node.said))


@pytest.mark.large
def test_an_orientation_that_was_given_wins(foreign_packages, live_node, start_process) -> None:
    camera = MAST * CAMERAS["about x"]
    start_process(sys.executable, SPEAKER, *mounted(CAMERAS["about z"]))  # another one than the edges are measured with
    orientation = str(camera.as_quat().tolist())
    live_node.start(*EVERY_MESSAGE, PATIENT, f"edge_sensor_orientations:={orientation}")
    for second in range(SECONDS):
        live_node.odometry.publish(odometry(second))
    for number in range(4):
        live_node.edges.publish(closure(number, number, CAMERAS["about x"]))
    live_node.spin_until(lambda: live_node.status["edges"] == str(SECONDS + 3))
    live_node.wait_for_silence()
    live_node.spin_until(lambda: len(live_node.flags[-1].edge_ids) == SECONDS + 3)
    # The camera's place is not told, and its lever bends the path a little.
    assert all(residuals(live_node, number)[0] < 1e-2 for number in range(4))
    assert live_node.status["waiting for frames"] == "0"


class Intake:
    """Edges of a camera, without DDS."""

    def __init__(self, executor: SingleThreadedExecutor, wait_s: float) -> None:
        self.executor, self.handed_on = executor, []
        node = executor.get_nodes()[0]
        self.frames = edge_frames.EdgeFrames(node, wait_s, lambda record, _: self.handed_on.append(record))
        self.frames.note_body("r", "base_link", (0.0, 0.0, 0.0, 1.0))
        self._topic = Input("/edges", "any", "edge_topics", "", QoSProfile(depth=1))

    def take(self, number: int, frame: str = "camera", robots: tuple[str, str] = ("r", "r")) -> None:
        source, target = (Reference(robot, number + later) for later, robot in enumerate(robots))
        edge = EdgeMeasurement(number, source, target, (0.0, 0.0, 0.0, 1.0))
        self.frames.take(EdgeRecord(edge, frame_id=frame), self._topic)


@pytest.fixture
def executor(monkeypatch: pytest.MonkeyPatch) -> Iterator[SingleThreadedExecutor]:
    """Of a node that listens to transforms, which nobody sends."""
    monkeypatch.setattr(edge_frames, "_tf_message", lambda: Empty)
    context = rclpy.Context()
    rclpy.init(context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(rclpy.create_node("frames", context=context))
    yield executor
    for node in executor.get_nodes():
        node.destroy_node()
    executor.shutdown()
    rclpy.shutdown(context=context)


def test_edges_that_flow_do_not_keep_the_first_waiting(executor: SingleThreadedExecutor) -> None:
    intake = Intake(executor, wait_s=0.0)
    for number in range(1000):
        intake.take(number)
        executor.spin_once(timeout_sec=0.01)
        if intake.handed_on:
            break
    assert intake.handed_on[0].edge.edge_id == 0


def placed(parent: str, child: str, turned: Rotation) -> SimpleNamespace:
    """A static transform, as ``tf2_msgs/TFMessage``."""
    transform = SimpleNamespace(rotation=xyzw(turned), translation=Point())
    header = SimpleNamespace(frame_id=parent)
    return SimpleNamespace(transforms=[SimpleNamespace(header=header, child_frame_id=child, transform=transform)])


def test_a_transform_is_the_moment_to_look(executor: SingleThreadedExecutor) -> None:
    intake = Intake(executor, wait_s=1000.0)
    intake.take(0)
    intake.frames.note_transforms(placed("base_link", "camera", MAST))
    assert len(intake.handed_on) == 1 and intake.frames.waiting == 0


@pytest.mark.parametrize("alike", [True, False])
def test_cameras_that_two_robots_carry_differently_are_warned_of_once(
    executor: SingleThreadedExecutor, capfd: pytest.CaptureFixture[str], alike: bool
) -> None:
    intake = Intake(executor, wait_s=1000.0)
    for robot, turned in (("red", MAST), ("blue", MAST if alike else CAMERAS["about x"])):
        intake.frames.note_body(robot, f"{robot}/base_link", (0.0, 0.0, 0.0, 1.0))
        intake.frames.note_transforms(placed(f"{robot}/base_link", f"{robot}/camera", turned))
    for number in range(3):
        intake.take(number, "red/camera", ("red", "blue"))
    assert len(intake.handed_on) == 3
    told = "/edges: red/camera is mounted differently on red and on blue"
    assert capfd.readouterr().err.count(told) == (not alike)


def test_without_the_name_of_a_bodys_frame_no_transform_is_asked_for(
    executor: SingleThreadedExecutor, capfd: pytest.CaptureFixture[str]
) -> None:
    """Odometry of poses alone, or none: what the log had proposed, a transform, could not have helped."""
    intake = Intake(executor, wait_s=0.0)
    intake.take(0, "base_link", ("s", "s"))
    for _ in range(100):
        executor.spin_once(timeout_sec=0.01)
        if intake.handed_on:
            break
    said = capfd.readouterr().err
    assert "base_link sits on the body of s" in said and "names the frame of the body" in said and "/tf" not in said
    # Odometry that comes later shows that they are the body's edges: there is nothing to begin anew for.
    intake.frames.note_body("s", "base_link", (0.0, 0.0, 0.0, 1.0))
    intake.take(1, "base_link", ("s", "s"))
    assert len(intake.handed_on) == 2 and "~/reset" not in capfd.readouterr().err
