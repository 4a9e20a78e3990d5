"""Edges that a replay cannot use are told, and none of them passes for not being there."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION, typestore
from rotavg_ros.bags.messages import odometry_message
from rotavg_ros.bags.writer import BagWriter
from rotavg_ros.cli.main import main

NOTHING = np.zeros(4)


def _reference(*, robot: str = "", keyframe_id: int = 0, stamp_s: float | None = None):
    types = typestore().types
    seconds, rest = divmod(round((stamp_s or 0.0) * 1e9), 10**9)
    stamp = types["builtin_interfaces/msg/Time"](sec=seconds, nanosec=rest)
    by = 0 if stamp_s is None else 1
    return types["rotavg_msgs/msg/KeyframeReference"](by=by, robot=robot, id=keyframe_id, stamp=stamp)


def _closure(number: int, source, target):
    types = typestore().types
    header = odometry_message(10**9 + number, np.zeros(3), np.array([0.0, 0.0, 0.0, 1.0]), "base_link").header
    return types[RELATIVE_ROTATION](
        header=header,
        id=number,
        sequence=number,
        source=source,
        target=target,
        rotation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        precision=0.0,
        translation=np.zeros(0),
        translation_precision=0.0,
        kind=1,
    )


def _bag(folder: Path, closures: list, *, is_oriented: bool = True, first: int = 0) -> Path:
    """Five seconds of odometry from 1 s on, of which the ``first`` messages have no orientation, and closures."""
    with BagWriter(folder) as bag:
        bag.add_topic("/odom", ODOMETRY)
        bag.add_topic("/relative_rotations", RELATIVE_ROTATION)
        for index in range(50):
            stamp = 10**9 + index * 10**8
            orientation = np.array([0.0, 0.0, 0.0, 1.0]) if is_oriented and index >= first else NOTHING
            bag.write("/odom", stamp, odometry_message(stamp, np.array([0.1 * index, 0.0, 0.0]), orientation, "odom"))
        for number, (source, target) in enumerate(closures, start=1):
            bag.write("/relative_rotations", 6 * 10**9, _closure(number, source, target))
    return folder


@pytest.mark.parametrize(
    ("ends", "told"),
    [
        (
            {"robot": "red"},
            "1 edge was not used: it is about robots that are not known, such as 'red'; known",
        ),
        (
            {"stamp_s": 99.5},
            "1 edge was not used: it is of moments that the odometry taken does not reach, such as 99.5",
        ),
        ({"keyframe_id": 4711, "stamp_s": None}, "it is about keyframes that never came, such as 4711 of 'robot'"),
    ],
)
def test_what_waits_at_the_end(tmp_path: Path, capsys: pytest.CaptureFixture[str], ends: dict, told: str) -> None:
    bag = _bag(tmp_path / "bag", [(_reference(stamp_s=1.5), _reference(**({"stamp_s": 3.0} | ends)))])
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    said = capsys.readouterr()
    assert told in said.err
    assert "no loop closure of this bag could be used" in said.out
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["waiting"] == 1
    assert told in summary["warnings"][0]


def test_nothing_waits(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """And a filter that has yet to find its orientation is odometry."""
    bag = _bag(tmp_path / "bag", [(_reference(stamp_s=2.5), _reference(stamp_s=4.0))], first=5)
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 0
    assert capsys.readouterr().err == ""
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert (summary["waiting"], summary["warnings"], summary["loop_closures"]) == (0, [], 1)
    assert summary["rejected"] == {"zero_quaternion": 5}


def test_no_odometry_that_states_an_orientation(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    bag = _bag(tmp_path / "bag", [(_reference(stamp_s=1.5), _reference(stamp_s=3.0))], is_oriented=False)
    assert main(["replay", str(bag), "--output", str(tmp_path / "out"), "--no-report"]) == 2
    said = capsys.readouterr().err
    assert "1 edge names moments, and no topic was taken for odometry" in said
    assert "/odom: none of its first 100 messages states an orientation" in said
