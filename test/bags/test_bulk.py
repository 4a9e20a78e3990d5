"""Sequences in bulk: the bytes that the library makes of as many objects."""

from __future__ import annotations

from typing import Any

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from rotavg_ros.bags import answer_messages, bulk
from rotavg_ros.bags.message_types import typestore
from rotavg_ros.online.answer.drawing import PALETTE, Drawing
from rotavg_ros.online.answer.trajectory import Trajectory

FRAMES = st.text("abcdefgh_/ö", max_size=12)  # so that a header ends anywhere in a word


def types(*names: str) -> list[Any]:
    return [typestore().types[name] for name in names]


@settings(deadline=None, max_examples=40)
@given(count=st.integers(0, 4), frame=FRAMES, seed=st.integers(0, 100), lost=st.integers(0, 5))
def test_a_path(count: int, frame: str, seed: int, lost: int) -> None:
    rng = np.random.default_rng(seed)
    stamps = np.sort(rng.integers(-5, 2**61, count))  # before time begins, and after it ends
    numbers = rng.normal(size=(count, 7))
    unused = np.zeros(count, dtype=np.int64)
    numbers[:lost, :3] = np.nan
    trajectory = Trajectory(
        unused, stamps, unused, numbers[:, 3:], numbers[:, :3], numbers[:, :3], numbers[:, 3:], numbers[:, :3]
    )
    message = answer_messages.path_message(trajectory, frame)
    header, time, stamped, pose, point, quaternion = types(
        *("std_msgs/msg/Header", "builtin_interfaces/msg/Time", "geometry_msgs/msg/PoseStamped"),
        *("geometry_msgs/msg/Pose", "geometry_msgs/msg/Point", "geometry_msgs/msg/Quaternion"),
    )
    poses = []
    shown = slice(lost if lost < count else 0, None)  # all, at the origin, where no position is known
    for stamp, row in zip(stamps[shown].tolist(), np.nan_to_num(numbers)[shown].tolist(), strict=True):
        at = divmod(stamp, 10**9) if 0 <= stamp < 2**31 * 10**9 else (0, 0)
        poses.append(stamped(header(time(*at), frame), pose(point(*row[:3]), quaternion(*row[3:]))))
    expected = typestore().types["nav_msgs/msg/Path"](header=message.header, poses=poses)
    assert bulk.serialize(message, "nav_msgs/msg/Path") == bytes(
        typestore().serialize_cdr(expected, "nav_msgs/msg/Path")
    )


@settings(deadline=None, max_examples=40)
@given(keyframes=st.integers(0, 3), edges=st.integers(0, 3), frame=FRAMES)
def test_markers(keyframes: int, edges: int, frame: str) -> None:
    rng = np.random.default_rng(keyframes)
    shades = rng.integers(0, len(PALETTE), edges)
    drawing = Drawing(rng.normal(size=(keyframes, 3)), rng.normal(size=(2 * edges, 3)), shades)
    name = "visualization_msgs/msg/MarkerArray"
    message = answer_messages.markers_message(drawing, frame)
    found = bulk.serialize(message, name)
    point, color = types("geometry_msgs/msg/Point", "std_msgs/msg/ColorRGBA")
    spheres, lines = message.markers
    object.__setattr__(spheres, "points", [point(*row) for row in drawing.keyframes.tolist()])
    object.__setattr__(lines, "points", [point(*row) for row in drawing.edge_ends.tolist()])
    object.__setattr__(lines, "colors", [color(*PALETTE[shade]) for shade in shades for _ in range(2)])
    assert found == bytes(typestore().serialize_cdr(message, name))
