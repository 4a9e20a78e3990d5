"""A bag whose edges are measured between cameras: the replay takes them into the body's frame by its /tf_static."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION, typestore
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message
from rotavg_ros.bags.reader import BagReader
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.cli.main import main
from rotavg_ros.settings.parameters import NodeParameters
from rotavg_ros.settings.text import to_yaml

TF = "tf2_msgs/msg/TFMessage"
CAMERA = Rotation.from_euler("zx", [90, 90], degrees=True)
LEVER = np.array([0.4, -0.2, 0.1])
SECONDS, LAP = 12, 6
EVERY_MESSAGE = ["-p", "keyframe_angle_deg:=0", "-p", "keyframe_distance_m:=0", "-p", "solve_period_s:=10.0"]
GIVEN = ["-p", f"edge_sensor_orientations:={CAMERA.as_quat().tolist()}"]


def stamp(second: int) -> int:
    return (1000 + second) * 10**9


def body(second: int) -> tuple[Rotation, np.ndarray]:
    """Two laps of a ramp that winds up: no two axes of turns are the same."""
    heading = 60 * second
    here = np.array([np.cos(np.radians(heading)), np.sin(np.radians(heading)), 0.1 * second])
    return Rotation.from_euler("zx", [heading + 90, 10 + 3 * second], degrees=True), 2 * here


def closure(number: int) -> Any:
    """From a second to the one a lap later, between poses of the camera."""
    (start, start_position), (end, end_position) = (
        (turned * CAMERA, here + turned.apply(LEVER)) for turned, here in (body(number), body(number + LAP))
    )
    edge = Edge(
        stamp_ns=stamp(SECONDS),
        id=number,
        sequence=number + 1,
        source=Keyframe(None, stamp(number)),
        target=Keyframe(None, stamp(number + LAP)),
        source_from_target=(start.inv() * end).as_quat(),
        precision=float("nan"),
        kind=1,
        translation=start.inv().apply(end_position - start_position),
    )
    message = edge_message(edge)
    message.header.frame_id = "camera"
    return message


def static_transform(parent: str = "base_link", child: str = "camera", turned: Rotation = CAMERA) -> Any:
    types = typestore().types
    qx, qy, qz, qw = turned.as_quat().tolist()
    x, y, z = LEVER.tolist()
    transform = types["geometry_msgs/msg/Transform"](
        types["geometry_msgs/msg/Vector3"](x, y, z), types["geometry_msgs/msg/Quaternion"](qx, qy, qz, qw)
    )
    header = types["std_msgs/msg/Header"](types["builtin_interfaces/msg/Time"](sec=0, nanosec=0), parent)
    return types[TF]([types["geometry_msgs/msg/TransformStamped"](header, child, transform)])


def write_bag(path: Path, with_tf: bool, nameless: int = 0) -> None:
    """The transform comes last, as where its broadcaster was started late; the first messages may name no body."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {"/odom": ODOMETRY, "/relative_rotations": RELATIVE_ROTATION, "/tf_static": TF}
        connections = {
            topic: writer.add_connection(topic, kind, typestore=typestore()) for topic, kind in topics.items()
        }

        def write(topic: str, stamp_ns: int, message: Any) -> None:
            writer.write(connections[topic], stamp_ns, typestore().serialize_cdr(message, topics[topic]))

        for second in range(SECONDS):
            turned, here = body(second)
            message = odometry_message(stamp(second), here, turned.as_quat(), "odom")
            message.child_frame_id = "" if second < nameless else "base_link"
            write("/odom", stamp(second), message)
        for number in range(LAP):
            write("/relative_rotations", stamp(SECONDS), closure(number))
        if with_tf:
            write("/tf_static", stamp(SECONDS + 1), static_transform())


def residuals(output: Path) -> tuple[np.ndarray, np.ndarray]:
    """Degrees and metres, of the closures in the last answer."""
    with BagReader(output / "run.mcap") as bag:
        *_, (_, _, flags) = bag.decoded(["/outlier_flags"])
    is_closure = np.asarray(flags.kinds) == 1
    assert is_closure.sum() == LAP
    return np.asarray(flags.residuals_deg)[is_closure], np.asarray(flags.residuals_m)[is_closure]


def replayed(bag: Path, output: Path, *options: str) -> dict[str, Any]:
    assert main(["replay", str(bag), "--output", str(output), "--no-report", *EVERY_MESSAGE, *options]) == 0
    return json.loads((output / "summary.json").read_text())


@pytest.mark.parametrize("nameless", [0, 1])
def test_the_bags_own_transforms(tmp_path: Path, nameless: int) -> None:
    write_bag(tmp_path / "bag", with_tf=True, nameless=nameless)
    summary = replayed(tmp_path / "bag", tmp_path / "out")
    degrees, metres = residuals(tmp_path / "out")
    assert (degrees < 1e-3).all() and (metres < 1e-3).all()
    assert summary["outliers"] == 0 and summary["warnings"] == []
    assert summary["topics"]["/tf_static"] == "frames of sensors"


def test_a_file_of_all_defaults_leaves_the_transforms_in_use(tmp_path: Path) -> None:
    """As `rotavg_node --print-parameters` writes it; an orientation that is stated would rule them out."""
    write_bag(tmp_path / "bag", with_tf=True)
    (tmp_path / "node.yaml").write_text(to_yaml(NodeParameters()))
    summary = replayed(tmp_path / "bag", tmp_path / "out", "--params", str(tmp_path / "node.yaml"))
    assert (residuals(tmp_path / "out")[0] < 1e-3).all()
    assert summary["topics"]["/tf_static"] == "frames of sensors"


@pytest.mark.parametrize("options", [[], ["-p", "edge_frames_from_tf:=false"]])
def test_edges_that_nothing_places_are_taken_as_they_are(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], options: list[str]
) -> None:
    write_bag(tmp_path / "bag", with_tf=bool(options))
    summary = replayed(tmp_path / "bag", tmp_path / "out", *options)
    assert residuals(tmp_path / "out")[0].max() > 1
    told = "/relative_rotations is in frame camera, but odometry tells of base_link"
    assert (told in capsys.readouterr().err) == (not options)
    assert any(told in warning for warning in summary["warnings"]) == (not options)


def test_odometry_that_does_not_name_the_body_is_told_of(tmp_path: Path) -> None:
    """Transforms are of no use then; nothing had been said."""
    write_bag(tmp_path / "bag", with_tf=True, nameless=SECONDS)
    (told,) = replayed(tmp_path / "bag", tmp_path / "out")["warnings"]
    assert told.startswith("/relative_rotations is in frame camera, but no odometry names the frame of the body")


@pytest.mark.parametrize("with_tf", [True, False])
def test_an_orientation_that_was_given_wins(tmp_path: Path, with_tf: bool) -> None:
    write_bag(tmp_path / "bag", with_tf)
    summary = replayed(tmp_path / "bag", tmp_path / "out", *GIVEN)
    degrees, _ = residuals(tmp_path / "out")
    # The camera's place is not told, and its lever bends the path a little.
    assert (degrees < 1e-2).all() and summary["warnings"] == [] and "/tf_static" not in summary["topics"]


def write_meeting(path: Path, robots: dict[str, Rotation]) -> None:
    """Robots that drive alike and see each other, by cameras that are turned on their bodies by these rotations."""
    with Writer(path, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        topics = {**{f"/{robot}/odom": ODOMETRY for robot in robots}, "/between": RELATIVE_ROTATION, "/tf_static": TF}
        connections = {
            topic: writer.add_connection(topic, kind, typestore=typestore()) for topic, kind in topics.items()
        }

        def write(topic: str, second: int, message: Any) -> None:
            writer.write(connections[topic], stamp(second), typestore().serialize_cdr(message, topics[topic]))

        for robot, turned in robots.items():
            write("/tf_static", 0, static_transform(f"{robot}/base_link", f"{robot}/camera", turned))
        for second in range(SECONDS):
            rotation, here = body(second)
            for robot in robots:
                message = odometry_message(stamp(second), here, rotation.as_quat(), "odom")
                message.child_frame_id = f"{robot}/base_link"
                write(f"/{robot}/odom", second, message)
        ends = [Keyframe(None, stamp(1), robot) for robot in robots]
        for number in range(2):
            edge = edge_message(Edge(stamp(SECONDS), number, number + 1, *ends, np.array([0.0, 0, 0, 1]), 1e4, 1))
            edge.header.frame_id = "red/camera"
            write("/between", SECONDS, edge)


@pytest.mark.parametrize("alike", [True, False])
def test_cameras_that_two_robots_carry_differently_are_warned_of_once(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], alike: bool
) -> None:
    write_meeting(tmp_path / "bag", {"red": CAMERA, "blue": CAMERA if alike else CAMERA.inv()})
    topics = ["--odometry", "/red/odom", "--odometry", "/blue/odom"]
    summary = replayed(tmp_path / "bag", tmp_path / "out", *topics)
    told = "/between: red/camera is mounted differently on red and on blue"
    assert sum(told in warning for warning in summary["warnings"]) == (not alike)
    assert capsys.readouterr().err.count(told) == (not alike)


def test_a_cameras_odometry_begins_anew_at_the_cameras_zero(tmp_path: Path) -> None:
    """It is started again after a silence, in which the robot might as well have driven back."""
    with BagWriter(tmp_path / "bag") as bag:
        bag.add_topic("/odom", ODOMETRY)
        for first in (0, 70):
            for index in range(40):
                turned = CAMERA.inv() * Rotation.from_euler("z", 3 * index, degrees=True) * CAMERA
                here, moment = CAMERA.inv().apply([0.2 * index, 0.0, 0.0]), stamp(0) + (first + index) * 10**8
                bag.write("/odom", moment, odometry_message(moment, here, turned.as_quat(), "odom"))
    mounted = ["-p", f"odometry_sensor_orientations:={CAMERA.as_quat().tolist()}", "--no-report"]
    assert main(["replay", str(tmp_path / "bag"), "--output", str(tmp_path / "answer"), *mounted]) == 0
    summary = json.loads((tmp_path / "answer" / "summary.json").read_text())
    assert (summary["components"], summary["rejected"]) == (2, {"odometry_jump": 1})
