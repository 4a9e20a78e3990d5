"""Messages with thousands of points or poses, serialised a sequence at a time.

The library makes an object of every point and packs each separately: a path of 8000 poses takes 100 ms. Here a sequence
of uniform elements is one array. The bytes are the same as the library's; a test checks this.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray
from rosbags.interfaces import Nodetype

from rotavg_ros.bags.message_types import typestore

# Little-endian CDR without options.
_ENCAPSULATION = b"\x00\x01\x00\x00"
_NAMES = "bool byte uint8 int8 uint16 int16 uint32 int32 uint64 int64 float32 float64"
_FORMATS = dict(zip(_NAMES.split(), "?BBbHhIiQqfd", strict=True))


@dataclass(frozen=True)
class Rows:
    """Stands for a sequence of messages whose fields are all numbers of one type, such as points.

    Attributes:
        values: ``(K, k)``, of the fields' type.
    """

    values: NDArray[Any]


@dataclass(frozen=True)
class StampedPoses:
    """Stands for a sequence of ``geometry_msgs/msg/PoseStamped``.

    Attributes:
        stamp: ``(K, 2)`` int64 seconds and nanoseconds.
        frame_id: the frame of all poses.
        pose: ``(K, 7)`` position and orientation.
    """

    stamp: NDArray[np.int64]
    frame_id: str
    pose: NDArray[np.float64]


Bulk: TypeAlias = Rows | StampedPoses


def serialize(message: Any, type_name: str) -> bytes:
    """A message's CDR; sequences in it may be :data:`Bulk`."""
    out = bytearray()
    _put_message(out, message, type_name)
    return _ENCAPSULATION + bytes(out)


def _put_message(out: bytearray, message: Any, type_name: str) -> None:
    for name, node in typestore().fielddefs[type_name][1]:
        _put(out, getattr(message, name), node)


def _put(out: bytearray, value: Any, node: Any) -> None:
    kind, about = node
    if kind == Nodetype.NAME:
        _put_message(out, value, about)
    elif kind == Nodetype.BASE:
        _put_base(out, value, about[0])
    elif isinstance(value, Rows):
        _put_base(out, len(value.values), "uint32")
        if value.values.size:
            _align(out, value.values.itemsize)
            out += np.ascontiguousarray(value.values).tobytes()
    elif isinstance(value, StampedPoses):
        _put_base(out, len(value.pose), "uint32")
        _put_poses(out, value)
    else:
        _put_base(out, len(value), "uint32")
        for element in value:
            _put(out, element, about[0])


def _put_base(out: bytearray, value: Any, name: str) -> None:
    if name == "string":
        text = value.encode() + b"\0"
        _put_base(out, len(text), "uint32")
        out += text
        return
    form = _FORMATS[name]
    _align(out, struct.calcsize(form))
    out += struct.pack(f"<{form}", value)


def _align(out: bytearray, size: int) -> None:
    out += bytes(-len(out) % size)


def _put_poses(out: bytearray, poses: StampedPoses) -> None:
    """Append poses. Each ends at a multiple of 8 bytes, so all but the first have the same padding."""
    for rows in (slice(0, 1), slice(1, None)):
        stamp, pose = poses.stamp[rows], poses.pose[rows]
        head = bytearray(len(out) % 8 * b"\0")  # the first one's offset in a word of 8 bytes
        begin = len(head)
        for part in (0, 0):
            _put_base(head, part, "uint32")
        _put_base(head, poses.frame_id, "string")
        _align(head, 8)
        element = np.zeros(
            len(pose), dtype=[("stamp", "<u4", 2), ("rest", "u1", len(head) - begin - 8), ("pose", "<f8", 7)]
        )
        element["stamp"], element["pose"] = stamp, pose
        element["rest"] = np.frombuffer(bytes(head[begin + 8 :]), dtype=np.uint8)
        out += element.tobytes()
