"""The node's outputs as messages for a bag, bit for bit those of :mod:`rotavg_ros.ros`; a test checks this."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from rotavg_ros.bags.bulk import Rows, StampedPoses
from rotavg_ros.bags.message_types import typestore
from rotavg_ros.online import Answer
from rotavg_ros.online.answer.drawing import EDGE_WIDTH_M, KEYFRAME_COLOR, KEYFRAME_SIZE_M, PALETTE, Drawing
from rotavg_ros.online.answer.trajectory import Trajectory
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.stamps import NANOSECONDS

ORIENTATIONS = "rotavg_msgs/msg/AbsoluteOrientations"
FLAGS = "rotavg_msgs/msg/OutlierFlags"
ORIENTATION = "geometry_msgs/msg/QuaternionStamped"
PATH = "nav_msgs/msg/Path"
MARKERS = "visualization_msgs/msg/MarkerArray"
DIAGNOSTICS = "diagnostic_msgs/msg/DiagnosticArray"

_END_OF_TIME_S = 2**31  # seconds of a stamp are signed 32-bit


def orientations_message(answer: Answer, frame_id: str) -> Any:
    """A ``rotavg_msgs/msg/AbsoluteOrientations``."""
    return _make(
        ORIENTATIONS,
        header=_header(answer.newest_stamp_ns, frame_id),
        robots=list(answer.robots),
        keyframe_robots=answer.keyframe_robot.astype(np.uint32),
        keyframe_ids=answer.keyframe_id,
        stamps_ns=answer.stamp_ns,
        orientations=answer.world_from_body.ravel(),
        components=answer.component.astype(np.uint32),
        uncertainties_deg=np.degrees(answer.uncertainty).astype(np.float32),
    )


def flags_message(answer: Answer, frame_id: str) -> Any:
    """A ``rotavg_msgs/msg/OutlierFlags``."""
    return _make(
        FLAGS,
        header=_header(answer.newest_stamp_ns, frame_id),
        edge_ids=answer.edge_id,
        robots=list(answer.robots),
        source_robots=answer.keyframe_robot[answer.source].astype(np.uint32),
        source_ids=answer.keyframe_id[answer.source],
        target_robots=answer.keyframe_robot[answer.target].astype(np.uint32),
        target_ids=answer.keyframe_id[answer.target],
        kinds=answer.kind.astype(np.uint8),
        scores=answer.outlier_score.astype(np.float32),
        outliers=answer.outlier,
        rotation_scores=_or_nothing(answer.rotation_score),
        residuals_deg=answer.residual_deg.astype(np.float32),
        residuals_m=_or_nothing(answer.residual_m),
    )


def _or_nothing(values: NDArray[np.float64] | None) -> NDArray[np.float32]:
    return np.empty(0, dtype=np.float32) if values is None else values.astype(np.float32)


def orientation_message(stamp_ns: int, world_from_body: Quaternion, frame_id: str) -> Any:
    """A ``geometry_msgs/msg/QuaternionStamped``."""
    return _make(ORIENTATION, header=_header(stamp_ns, frame_id), quaternion=_quaternion(world_from_body))


def path_message(trajectory: Trajectory, frame_id: str) -> Any:
    """A ``nav_msgs/msg/Path`` with its poses in bulk; the origin where no position is known."""
    rows = trajectory.on_path
    stamp = np.stack(np.divmod(trajectory.stamp_ns[rows], NANOSECONDS), axis=1)
    stamp[(stamp[:, 0] < 0) | (stamp[:, 0] >= _END_OF_TIME_S)] = 0
    pose = np.concatenate((np.nan_to_num(trajectory.position), trajectory.world_from_body), axis=1)[rows]
    poses = StampedPoses(stamp, frame_id, pose)
    newest = int(trajectory.stamp_ns[-1]) if len(trajectory.stamp_ns) else 0
    return _make(PATH, header=_header(newest, frame_id), poses=poses)


def markers_message(drawing: Drawing, frame_id: str) -> Any:
    """A ``visualization_msgs/msg/MarkerArray``: a sphere list of keyframes and a line list of edges, points in bulk."""
    marker, color = _type("visualization_msgs/msg/Marker"), _type("std_msgs/msg/ColorRGBA")
    size = {"x": KEYFRAME_SIZE_M, "y": KEYFRAME_SIZE_M, "z": KEYFRAME_SIZE_M}
    upright = _make("geometry_msgs/msg/Pose", orientation=_quaternion((0.0, 0.0, 0.0, 1.0)))
    spheres = _make(
        "visualization_msgs/msg/Marker",
        header=_header(0, frame_id),
        ns="keyframes",
        type=marker.SPHERE_LIST,
        pose=upright,
        scale=_make("geometry_msgs/msg/Vector3", **size),
        color=color(*KEYFRAME_COLOR),
        points=Rows(drawing.keyframes),
    )
    lines = _make(
        "visualization_msgs/msg/Marker",
        header=_header(0, frame_id),
        ns="edges",
        type=marker.LINE_LIST,
        pose=upright,
        scale=_make("geometry_msgs/msg/Vector3", x=EDGE_WIDTH_M),
        points=Rows(drawing.edge_ends),
        colors=Rows(np.repeat(np.array(PALETTE, dtype=np.float32)[drawing.edge_shades], 2, axis=0)),
    )
    return _make(MARKERS, markers=[spheres, lines])


def diagnostics_message(stamp_ns: int, level: int, name: str, message: str, values: Mapping[str, str]) -> Any:
    """A ``diagnostic_msgs/msg/DiagnosticArray`` of one status."""
    pair = _type("diagnostic_msgs/msg/KeyValue")
    status = _make(
        "diagnostic_msgs/msg/DiagnosticStatus",
        level=level,
        name=name,
        message=message,
        hardware_id=values.get("device", ""),
        values=[pair(key=key, value=value) for key, value in values.items()],
    )
    return _make(DIAGNOSTICS, header=_header(stamp_ns, ""), status=[status])


def _header(stamp_ns: int, frame_id: str) -> Any:
    seconds, nanosec = divmod(stamp_ns, NANOSECONDS)
    time = (seconds, nanosec) if 0 <= seconds < _END_OF_TIME_S else (0, 0)
    return _type("std_msgs/msg/Header")(stamp=_type("builtin_interfaces/msg/Time")(*time), frame_id=frame_id)


def _quaternion(xyzw: Iterable[float]) -> Any:
    return _type("geometry_msgs/msg/Quaternion")(*xyzw)


@cache
def _type(name: str) -> Any:
    return typestore().types[name]


def _make(type_name: str, /, **values: Any) -> Any:
    """A message in which fields that are not given are zero or empty."""
    _, fields = typestore().fielddefs[type_name]
    return _type(type_name)(**{field: values[field] if field in values else _zero(node) for field, node in fields})


def _zero(node: Any) -> Any:
    kind, about = node
    if kind == Nodetype.NAME:
        return _make(about)
    if kind == Nodetype.BASE:
        return {"string": "", "bool": False}.get(about[0], 0.0 if about[0].startswith("float") else 0)
    assert kind == Nodetype.SEQUENCE, "no message of ours has arrays of fixed length"
    (element, detail), _ = about
    numeric = element == Nodetype.BASE and detail[0] != "string"
    return np.empty(0, dtype=np.uint8 if detail[0] == "byte" else detail[0]) if numeric else []
