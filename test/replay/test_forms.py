"""The same bag in other forms, and others' packages: the same answer."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Rosbag1Writer
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import get_types_from_msg
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.reader import BagReader
from rotavg_ros.cli.main import main

from .bag_forms import FORMS, INTERFACES, foreign_typestore, ros1_typestore

SHORT = ["--no-report", "--answers", "1", "-p", "solve_period_s:=1000.0", "--duration", "120"]
CSV = ("orientations.csv", "edges.csv", "trajectory.tum")


@pytest.fixture(scope="session")
def expected(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("forms") / "expected"
    assert main(["replay", str(bag), "--output", str(output), *SHORT]) == 0
    return output


# Each storage, each kind of compression, and ROS 1.
ALWAYS = ("sqlite3, messages by zstd", "mcap, chunks by zstd", "mcap, file by zstd", "ROS 1")


@pytest.mark.parametrize(
    "form", [pytest.param(form, marks=() if form in ALWAYS else pytest.mark.large) for form in FORMS]
)
def test_every_form_of_a_bag_gives_the_same_answer(bag: Path, expected: Path, tmp_path: Path, form: str) -> None:
    copy = FORMS[form](bag, tmp_path)
    assert main(["replay", str(copy), "--output", str(tmp_path / "answer"), *SHORT]) == 0
    for name in CSV:
        assert (tmp_path / "answer" / name).read_bytes() == (expected / name).read_bytes()


def test_a_package_that_is_not_installed_is_decoded_by_the_bags_definitions(tmp_path: Path) -> None:
    """Kimera's graph of a square that closes: with its translations, and a closure that its sender has rejected."""
    package = "pose_graph_tools_msgs"
    store = foreign_typestore(package)
    graph = square_in_the_words_of(store)
    with Writer(tmp_path / "kimera", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kind = f"{package}/msg/PoseGraph"
        connection = writer.add_connection("/kimera/pose_graph", kind, typestore=store)
        writer.write(connection, 10**9, store.serialize_cdr(graph, kind))
    with BagReader(tmp_path / "kimera") as reader:
        assert reader.topics == {"/kimera/pose_graph": kind}
    assert main(["replay", str(tmp_path / "kimera"), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["keyframes"], summary["edges"], summary["outliers"]) == (4, 5, 1)
    corners = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(corners[:, 1:4], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], atol=1e-5)


@pytest.mark.parametrize("version", [{}, {"geometry_msgs/Pose relative_pose": "geometry_msgs/Pose2D relative_pose"}])
def test_slam_toolbox_in_both_versions_of_its_edges(tmp_path: Path, version: dict[str, str]) -> None:
    """Nodes one after the other, and the whole graph when its loop closes: what comes twice counts once."""
    store = foreign_typestore("slam_toolbox", version)
    graph, events = numbered_square_in_the_words_of(store)
    with Writer(tmp_path / "slam", version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        kinds = {kind: f"slam_toolbox/msg/{kind}" for kind in ("NewNodeEvent", "PoseGraph")}
        connections = {
            kind: writer.add_connection(f"/slam_toolbox/{kind}", name, typestore=store) for kind, name in kinds.items()
        }
        for second, event in enumerate(events):
            writer.write(
                connections["NewNodeEvent"], (100 + second) * 10**9, store.serialize_cdr(event, kinds["NewNodeEvent"])
            )
        writer.write(connections["PoseGraph"], 110 * 10**9, store.serialize_cdr(graph, kinds["PoseGraph"]))
    assert main(["replay", str(tmp_path / "slam"), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["keyframes"], summary["edges"], summary["loop_closures"]) == (4, 4, 1)
    assert (summary["outliers"], summary["rejected"]) == (0, {"duplicate_edge": 3})
    corners = np.loadtxt(tmp_path / "out" / "trajectory.tum")
    np.testing.assert_allclose(corners[:, 0], [100, 101, 102, 103])
    np.testing.assert_allclose(corners[:, 1:4], [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], atol=1e-5)
    heading = Rotation.from_quat(corners[:, 4:]).as_euler("ZYX", degrees=True)[:, 0] % 360
    np.testing.assert_allclose(heading, [0, 90, 180, 270], atol=1e-3)


ROS1_NAMES = {"from_id": "fromId", "to_id": "toId", "poses_id": "posesId", "map_to_odom": "mapToOdom"}
OTHER_NAMES = {"from_id": "begin", "to_id": "end"}
MAP_GRAPH = "rtabmap_msgs/msg/MapGraph"


@pytest.mark.parametrize("package", ["rtabmap_msgs", "rtabmap_ros"])
def test_rtabmap_in_the_words_of_ros1(tmp_path: Path, package: str) -> None:
    """Its fields have other names there, and its package had another one before 2022."""
    bag = rtabmaps_square(tmp_path / "old.bag", package, ROS1_NAMES)
    options = [] if package == "rtabmap_msgs" else ["--edges", f"/rtabmap/mapGraph:{MAP_GRAPH}"]
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report", *options]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["keyframes"], summary["edges"], summary["loop_closures"]) == (4, 4, 1)


def test_a_version_with_other_fields_is_refused_in_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = rtabmaps_square(tmp_path / "other.bag", "rtabmap_msgs", OTHER_NAMES)
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 2
    told = capsys.readouterr().err
    assert told.startswith(f"rotavg: error: {bag}: /rtabmap/mapGraph is {MAP_GRAPH}, in a version with other fields")
    assert told.count("\n") == 1


def rtabmaps_square(path: Path, package: str, names: dict[str, str]) -> Path:
    """A ROS 1 bag with RTAB-Map's graph of a square that closes, its fields renamed."""
    store, texts = ros1_typestore(), {}
    for each in ("Link", "MapGraph"):
        texts[each] = (INTERFACES / "rtabmap_msgs" / "msg" / f"{each}.msg").read_text(encoding="utf-8")
        for old, new in names.items():
            texts[each] = texts[each].replace(old, new)
        store.register(get_types_from_msg(texts[each], f"{package}/msg/{each}"))
    types = store.types
    turn = types["geometry_msgs/msg/Quaternion"](*Rotation.from_euler("z", 90, degrees=True).as_quat())
    step = types["geometry_msgs/msg/Transform"](types["geometry_msgs/msg/Vector3"](1.0, 0.0, 0.0), turn)
    ends = [(0, 1, 0), (1, 2, 0), (2, 3, 0), (3, 0, 1)]
    links = [types[f"{package}/msg/Link"](*each, step, np.eye(6).ravel() * 1e4) for each in ends]
    header = types["std_msgs/msg/Header"](
        seq=0, stamp=types["builtin_interfaces/msg/Time"](sec=103, nanosec=0), frame_id="map"
    )
    graph = types[f"{package}/msg/MapGraph"](header, step, np.arange(4, dtype=np.int32), [], links)
    with Rosbag1Writer(path) as writer:
        connection = writer.add_connection("/rtabmap/mapGraph", f"{package}/msg/MapGraph", typestore=store)
        writer.write(connection, 10**9, store.serialize_ros1(graph, f"{package}/msg/MapGraph"))
    return path


def numbered_square_in_the_words_of(store):
    """A ``slam_toolbox/PoseGraph`` and the ``NewNodeEvent`` of each of its nodes."""
    types = store.types
    time, point = types["builtin_interfaces/msg/Time"], types["geometry_msgs/msg/Point"]
    x, y, z, w = Rotation.from_euler("z", 90, degrees=True).as_quat()
    spatial = types["geometry_msgs/msg/Pose"](point(1.0, 0.0, 0.0), types["geometry_msgs/msg/Quaternion"](x, y, z, w))
    step = spatial
    if "Pose2D" in str(store.fielddefs["slam_toolbox/msg/GraphEdge"]):
        step = types["geometry_msgs/msg/Pose2D"](x=1.0, y=0.0, theta=np.pi / 2)

    def edge(source: int, target: int):
        return types["slam_toolbox/msg/GraphEdge"](source, target, step, np.eye(3).ravel() * 1e-4)

    events = [
        types["slam_toolbox/msg/NewNodeEvent"](
            corner, time(sec=100 + corner, nanosec=0), spatial, edge(max(corner - 1, 0), corner)
        )
        for corner in range(4)
    ]
    nodes = [types["slam_toolbox/msg/GraphNode"](corner, spatial) for corner in range(4)]
    header = types["std_msgs/msg/Header"](time(sec=110, nanosec=0), "map")
    return types["slam_toolbox/msg/PoseGraph"](header, nodes, [edge(3, 0), *(edge(k, k + 1) for k in range(3))]), events


def square_in_the_words_of(store):
    """A ``pose_graph_tools_msgs/PoseGraph``."""
    types = store.types

    def header(corner: int):
        stamp = types["builtin_interfaces/msg/Time"](sec=100 + corner, nanosec=0)
        return types["std_msgs/msg/Header"](stamp=stamp, frame_id="world")

    def pose(position: list[float], heading_deg: float):
        x, y, z, w = Rotation.from_euler("z", heading_deg, degrees=True).as_quat()
        return types["geometry_msgs/msg/Pose"](
            position=types["geometry_msgs/msg/Point"](*position),
            orientation=types["geometry_msgs/msg/Quaternion"](x=x, y=y, z=z, w=w),
        )

    def edge(source: int, target: int, kind: int, heading_deg: float):
        return types["pose_graph_tools_msgs/msg/PoseGraphEdge"](
            header=header(target),
            key_from=source,
            key_to=target,
            robot_from=0,
            robot_to=0,
            type=kind,
            pose=pose([1.0, 0.0, 0.0], heading_deg),
            covariance=np.eye(6).ravel() * 1e-4,
        )

    nodes = [
        types["pose_graph_tools_msgs/msg/PoseGraphNode"](
            header=header(corner), robot_id=0, key=corner, pose=pose([0.0] * 3, 0.0)
        )
        for corner in range(4)
    ]
    odometry = [edge(corner, corner + 1, 0, 90.0) for corner in range(3)]
    return types["pose_graph_tools_msgs/msg/PoseGraph"](
        header=header(3), nodes=nodes, edges=[*odometry, edge(3, 0, 1, 90.0), edge(0, 2, 3, 5.0)]
    )
