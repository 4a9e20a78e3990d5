"""Two robots in one bag, joined by a closure between them."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from evo.tools import file_interface
from mcap.reader import make_reader
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION
from rotavg_ros.bags.messages import Edge, Keyframe, edge_message, odometry_message
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.formats import read_graph

COUNT = 30
STAMPS = 10**9 + 100_000_000 * np.arange(COUNT)


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Red drives along x, blue along its own x; at the end red sees blue turned by a quarter."""
    with BagWriter(tmp_path / "two") as bag:
        for robot in ("red", "blue"):
            bag.add_topic(f"/{robot}/odom", ODOMETRY)
        bag.add_topic("/between", RELATIVE_ROTATION)
        for index, stamp in enumerate(STAMPS.tolist()):
            pose = np.array([index, 0.0, 0.0]), np.array([0.0, 0.0, 0.0, 1.0])
            for robot in ("red", "blue"):
                bag.write(f"/{robot}/odom", stamp, odometry_message(stamp, *pose, "odom"))
        last = int(STAMPS[-1])
        ends = Keyframe(None, last, "red"), Keyframe(None, last, "blue")
        quarter = Rotation.from_euler("z", 90, degrees=True).as_quat()
        bag.write("/between", last, edge_message(Edge(last, 7, 1, *ends, quarter, 1e4, 1)))
    return tmp_path / "two"


def test_two_robots_share_one_world(bag: Path, tmp_path: Path) -> None:
    topics = ["--odometry", "/red/odom", "--odometry", "/blue/odom"]
    output = tmp_path / "out"
    assert main(["replay", str(bag), "--output", str(output), *topics]) == 0
    summary = json.loads((output / "summary.json").read_text())
    assert set(summary["robots"]) == {"red", "blue"}
    assert (summary["components"], summary["keyframes"], summary["loop_closures"]) == (1, 2 * COUNT, 1)

    red, blue = (file_interface.read_tum_trajectory_file(str(output / f"{robot}.tum")) for robot in ("red", "blue"))
    turn = Rotation.from_matrix(red.poses_se3[-1][:3, :3]).inv() * Rotation.from_matrix(blue.poses_se3[-1][:3, :3])
    assert np.degrees(turn.magnitude()) == pytest.approx(90, abs=0.1)
    way = blue.positions_xyz[-1] - blue.positions_xyz[0]
    along = Rotation.from_matrix(blue.poses_se3[0][:3, :3]).apply([COUNT - 1, 0, 0])
    np.testing.assert_allclose(way, along, atol=1e-3)

    with (output / "orientations.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert [row["robot"] for row in rows] == ["0"] * COUNT + ["1"] * COUNT
    with (output / "run.mcap").open("rb") as file:
        topics_written = {channel.topic for _, channel, _ in make_reader(file).iter_messages()}
    assert {"/red/orientation", "/blue/orientation", "/red/corrected_path", "/blue/corrected_path"} <= topics_written
    assert (output / "report.html").exists()


def test_names_that_no_topic_can_have(bag: Path, tmp_path: Path) -> None:
    """The node refuses them, since it publishes; a replay writes files."""
    robots = ["-p", "robots:=['my robot', '1']", "-p", "odometry_topics:=['/red/odom', '/blue/odom']"]
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report", *robots]) == 0
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert set(summary["robots"]) == {"my robot", "1"}


@pytest.mark.parametrize(
    ("robots", "files"),
    [
        (("a b", "a/b"), ("a_b", "a_b_2")),
        (("red", "red_odometry"), ("red", "red_odometry_2")),
        (("red_odometry", "red"), ("red_odometry", "red_2")),
    ],
)
def test_robots_whose_files_would_have_one_name(
    bag: Path, tmp_path: Path, robots: tuple[str, str], files: tuple[str, str]
) -> None:
    words = ["--odometry", "/red/odom", "--odometry", "/blue/odom", "--robots", *robots]
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report", *words]) == 0
    written = {path.name for path in (tmp_path / "out").iterdir() if path.suffix in (".tum", ".kitti")}
    assert written == {f"{name}{suffix}" for name in files for suffix in (".tum", ".kitti", "_odometry.tum")}


def test_each_robots_odometry_is_that_of_the_graph(bag: Path, tmp_path: Path) -> None:
    """Formats without kinds take edges between consecutive ids for odometry: each robot's own steps, and no closure."""
    topics = ["--odometry", "/red/odom", "--odometry", "/blue/odom"]
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report", *topics]) == 0
    graph_file = read_graph(tmp_path / "out" / "graph.g2o")
    source, target = (graph_file.node_ids[end] for end in (graph_file.graph.source, graph_file.graph.target))
    is_odometry = graph_file.graph.is_odometry.numpy()
    assert np.count_nonzero(is_odometry) == 2 * (COUNT - 1)
    assert list(zip(source[~is_odometry], target[~is_odometry], strict=True)) == [(COUNT - 1, 2 * COUNT)]
    with (tmp_path / "out" / "orientations.csv").open() as file:
        ids = [int(row["id"]) for row in csv.DictReader(file)]
    assert ids == [*range(COUNT), *range(COUNT + 1, 2 * COUNT + 1)]
    assert ids == graph_file.node_ids.tolist()


@pytest.mark.parametrize("closes_by_place", [False, True])
@pytest.mark.parametrize("stamped", [0, 5])
def test_keyframes_without_stamps_have_a_place_in_the_graph(
    tmp_path: Path, closes_by_place: bool, stamped: int
) -> None:
    """A square of four sides, five steps each, by ids; the trajectory has those with stamps, the graph has all."""
    corner = Rotation.from_euler("z", [[90 if index % 5 == 4 else 0] for index in range(20)], degrees=True)
    with BagWriter(tmp_path / "square") as bag:
        bag.add_topic("/relative_rotations", RELATIVE_ROTATION)
        ends = [Keyframe(index, (index + 1) * 10**9 if index < stamped else 0) for index in range(21)]
        for index in range(20):
            step = np.array([1.0, 0.0, 0.0])
            edge = Edge(10**9, index, 0, ends[index], ends[index + 1], corner[index].as_quat(), 1e4, 0, step)
            bag.write("/relative_rotations", 10**9, edge_message(edge))
        place = np.zeros(3) if closes_by_place else None
        closure = Edge(10**9, 20, 0, ends[0], ends[20], np.array([0, 0, 0, 1.0]), 1e4, 1, place)
        bag.write("/relative_rotations", 10**9, edge_message(closure))
    assert main(["replay", str(tmp_path / "square"), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    rows = [line.split() for line in (tmp_path / "out" / "graph.g2o").read_text().splitlines() if "VERTEX" in line]
    corners = np.array([row[2:4] for row in rows[::5]], dtype=float)
    np.testing.assert_allclose(corners, [[0, 0], [5, 0], [5, 5], [0, 5], [0, 0]], atol=1e-3)
