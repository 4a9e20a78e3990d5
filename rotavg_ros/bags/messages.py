"""Converts numbers to ROS messages (as in `rosbags`) and back; ROS's conventions apply to the messages only."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.bags.message_types import typestore
from rotavg_ros.stamps import NANOSECONDS

# Unknown covariance: 36 zeros, as most odometry sources send.
_NO_COVARIANCE = np.zeros(36)


@cache
def _type(name: str) -> Any:
    return typestore().types[name]


@dataclass(frozen=True)
class Keyframe:
    """One end of an edge: named by id, or by stamp where the id is None. Stamp 0: not stated."""

    id: int | None
    stamp_ns: int
    robot: str = ""

    @property
    def key(self) -> tuple[str, bool, int]:
        """What identifies the end: equal for equal ends, whether or not their stamps are stated beside their ids."""
        return (self.robot, self.id is not None, self.stamp_ns if self.id is None else self.id)


@dataclass(frozen=True)
class Edge:
    """A relative rotation as a message carries it.

    Attributes:
        stamp_ns: when the edge became known.
        id: the sender's number of the edge.
        sequence: counts messages from 1; 0: not counted.
        source, target: its ends.
        source_from_target: ``(4,)`` xyzw, orientation of the target in the source frame.
        precision: rad⁻²; NaN: unknown.
        kind: :class:`rotavg_ros.view_graph.EdgeKind`.
        translation: ``(3,)`` position of the target in the source frame, metres; None: unknown.
        frame_id: frame of the sensor between whose poses it was measured; empty: the body's.
    """

    stamp_ns: int
    id: int
    sequence: int
    source: Keyframe
    target: Keyframe
    source_from_target: NDArray[np.float64]
    precision: float
    kind: int
    translation: NDArray[np.float64] | None = None
    frame_id: str = ""


def _time(stamp_ns: int) -> Any:
    seconds, nanoseconds = divmod(int(stamp_ns), NANOSECONDS)
    return _type("builtin_interfaces/msg/Time")(sec=seconds, nanosec=nanoseconds)


def _nanoseconds(time: Any) -> int:
    return int(time.sec) * NANOSECONDS + int(time.nanosec)


def _header(stamp_ns: int, frame_id: str) -> Any:
    return _type("std_msgs/msg/Header")(stamp=_time(stamp_ns), frame_id=frame_id)


def _quaternion(xyzw: NDArray[np.float64]) -> Any:
    x, y, z, w = xyzw.tolist()
    return _type("geometry_msgs/msg/Quaternion")(x=x, y=y, z=z, w=w)


def odometry_message(
    stamp_ns: int, position: NDArray[np.float64], world_from_body: NDArray[np.float64], frame_id: str
) -> Any:
    """Pose of ``base_link`` in ``frame_id``: ``(3,)`` metres and ``(4,)`` xyzw. The twist is left at zero."""
    x, y, z = position.tolist()
    zero = _type("geometry_msgs/msg/Vector3")(x=0.0, y=0.0, z=0.0)
    return _type("nav_msgs/msg/Odometry")(
        header=_header(stamp_ns, frame_id),
        child_frame_id="base_link",
        pose=_type("geometry_msgs/msg/PoseWithCovariance")(
            pose=_type("geometry_msgs/msg/Pose")(
                position=_type("geometry_msgs/msg/Point")(x=x, y=y, z=z),
                orientation=_quaternion(world_from_body),
            ),
            covariance=_NO_COVARIANCE,
        ),
        twist=_type("geometry_msgs/msg/TwistWithCovariance")(
            twist=_type("geometry_msgs/msg/Twist")(linear=zero, angular=zero), covariance=_NO_COVARIANCE
        ),
    )


def read_odometry(message: Any) -> tuple[int, list[float], list[float]]:
    """Stamp in ns, position and world-from-body xyzw of an Odometry message."""
    position, orientation = message.pose.pose.position, message.pose.pose.orientation
    return (
        _nanoseconds(message.header.stamp),
        [position.x, position.y, position.z],
        [orientation.x, orientation.y, orientation.z, orientation.w],
    )


def edge_message(edge: Edge) -> Any:
    """A ``rotavg_msgs/msg/RelativeRotation``."""
    return _type("rotavg_msgs/msg/RelativeRotation")(
        header=_header(edge.stamp_ns, edge.frame_id),
        id=edge.id,
        sequence=edge.sequence,
        source=_keyframe_message(edge.source),
        target=_keyframe_message(edge.target),
        rotation=_quaternion(edge.source_from_target),
        precision=edge.precision if np.isfinite(edge.precision) else 0.0,
        translation=_translation(edge.translation),
        translation_precision=0.0,
        kind=edge.kind,
    )


def _translation(translation: NDArray[np.float64] | None) -> NDArray[np.float64]:
    """The message's translation; empty if unknown."""
    if translation is None or not np.isfinite(translation).all():
        return np.empty(0)
    return np.asarray(translation, dtype=np.float64)


def read_edge(message: Any) -> Edge:
    """The edge in a ``rotavg_msgs/msg/RelativeRotation``."""
    rotation = message.rotation
    return Edge(
        stamp_ns=_nanoseconds(message.header.stamp),
        id=int(message.id),
        sequence=int(message.sequence),
        source=_read_keyframe(message.source),
        target=_read_keyframe(message.target),
        source_from_target=np.array([rotation.x, rotation.y, rotation.z, rotation.w]),
        precision=float(message.precision) if message.precision > 0 else float("nan"),
        kind=int(message.kind),
        translation=np.array(message.translation, dtype=np.float64) if len(message.translation) == 3 else None,
        frame_id=message.header.frame_id,
    )


def read_edges(message: Any) -> list[Edge]:
    """The edges in a ``rotavg_msgs/msg/RelativeRotationArray``."""
    edges = map(read_edge, message.edges)
    return [replace(edge, frame_id=edge.frame_id or message.header.frame_id) for edge in edges]


def _keyframe_message(keyframe: Keyframe) -> Any:
    kind = _type("rotavg_msgs/msg/KeyframeReference")
    return kind(
        by=kind.BY_STAMP if keyframe.id is None else kind.BY_ID,
        robot=keyframe.robot,
        id=keyframe.id or 0,
        stamp=_time(keyframe.stamp_ns),
    )


def _read_keyframe(message: Any) -> Keyframe:
    by_id = message.by == message.BY_ID
    return Keyframe(int(message.id) if by_id else None, _nanoseconds(message.stamp), message.robot)
