"""A bag that was recorded while another one played in a loop: every stamp comes twice."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from rotavg_ros.bags.message_types import typestore
from rotavg_ros.bags.reader import BagReader
from rotavg_ros.cli.main import main
from rotavg_ros.datasets.files.pose_files import read_pose_file
from rotavg_ros.replay.feed import read_references
from rotavg_ros.replay.plan import Input, Wishes, make_plan
from rotavg_ros.settings.parameters import NodeParameters

from .bag_forms import StoragePlugin, Writer
from .conftest import SELDOM

FIRST_S = 60


@pytest.fixture(scope="module")
def looped(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The simulated run's beginning twice, with the same stamps; closures refer to stamps or to keyframes."""
    folder = tmp_path_factory.mktemp("looped") / "looped"
    writer = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer, BagReader(bag) as reader:
        connections = {
            topic: writer.add_connection(topic, kind, typestore=typestore()) for topic, kind in reader.topics.items()
        }
        for turn in range(2):
            later_ns = turn * (FIRST_S + 1) * 10**9
            for message in reader.messages():
                if message.time_ns < reader.start_ns + FIRST_S * 10**9:
                    writer.write(connections[message.topic], message.time_ns + later_ns, message.data)
    return folder


@pytest.fixture(scope="module")
def once(bag: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("once") / "answer"
    duration = ["--duration", str(FIRST_S)]
    assert main(["replay", str(bag), "--output", str(output), "--no-report", *duration, *SELDOM]) == 0
    return output


@pytest.fixture(scope="module")
def twice(looped: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("twice") / "answer"
    assert main(["replay", str(looped), "--output", str(output), "--no-report", *SELDOM]) == 0
    return output


def summary(folder: Path) -> dict:
    return json.loads((folder / "summary.json").read_text())


def test_both_turns_are_kept_and_compared_with_their_own_reference(once: Path, twice: Path) -> None:
    first, both = summary(once), summary(twice)
    assert both["time_jumps"] == 1
    assert both["keyframes"] == 2 * first["keyframes"]
    (robot,), (both_robot,) = first["robots"].values(), both["robots"].values()
    assert both_robot["reference"] == robot["reference"]
    error, both_error = (each["orientation_error_mean_deg"]["odometry"] for each in (robot, both_robot))
    assert both_error == pytest.approx(error, rel=1e-3)


@pytest.mark.parametrize("gap", [0.0, 5.0])
def test_a_reference_has_both_turns_wherever_edges_are_placed(looped: Path, gap: float) -> None:
    with BagReader(looped) as reader:
        plan = make_plan(reader, {"max_odometry_gap_s": gap}, Wishes())
        inputs = {robot: source for robot, source in plan.references.items() if isinstance(source, Input)}
        (reference,) = read_references(reader, inputs, plan.parameters, reader.start_ns, reader.end_ns + 1).values()
    assert reference.time_line is not None
    first, second = (reference.stamp_ns[reference.time_line == turn].tolist() for turn in range(2))
    assert first == second and len(reference.stamp_ns) == 2 * len(first)


def test_a_reference_has_both_turns_though_its_stamps_repeat() -> None:
    """As those of a simulation whose clock is coarser than its messages."""
    stamps = [SimpleNamespace(sec=stamp, nanosec=0) for _ in range(2) for stamp in range(100, 130) for _ in range(2)]
    origin, upright = SimpleNamespace(x=0.0, y=0.0, z=0.0), SimpleNamespace(x=0.0, y=0.0, z=0.0, w=1.0)
    pose = SimpleNamespace(position=origin, orientation=upright)
    messages = [SimpleNamespace(header=SimpleNamespace(stamp=stamp, frame_id="map"), pose=pose) for stamp in stamps]
    bag: Any = SimpleNamespace(decoded=lambda *_: [("/truth", 0, message) for message in messages])
    inputs = {"robot": Input("/truth", "geometry_msgs/msg/PoseStamped")}
    (reference,) = read_references(bag, inputs, NodeParameters(), 0, 1).values()
    assert reference.time_line is not None
    turns = [(reference.stamp_ns[reference.time_line == turn] // 10**9).tolist() for turn in range(2)]
    assert turns == [list(range(100, 130))] * 2


def test_a_trajectory_has_every_stamp_once(once: Path, twice: Path) -> None:
    alone = read_pose_file(once / "trajectory.tum")
    for name in ("trajectory.tum", "trajectory_time_line_0.tum", "odometry.tum", "odometry_time_line_0.tum"):
        np.testing.assert_array_equal(read_pose_file(twice / name).stamps_ns, alone.stamps_ns)
    rows = (twice / "trajectory.kitti").read_text().splitlines()
    assert len(rows) == 2 * len(alone.position)
    assert not list(once.glob("*time_line*"))


def test_with_reset_only_the_last_turn_is_left(looped: Path, once: Path, tmp_path: Path) -> None:
    """As the bag's own replay, but for the closures that came before odometry had shown the jump."""
    output = tmp_path / "answer"
    assert (
        main(["replay", str(looped), "--output", str(output), "--no-report", *SELDOM, "-p", "on_time_jump:=reset"]) == 0
    )
    assert summary(output)["keyframes"] == summary(once)["keyframes"]
    assert not list(output.glob("*time_line*"))
