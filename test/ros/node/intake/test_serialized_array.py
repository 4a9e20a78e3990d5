"""Arrays are read from their serialised bytes as rclpy would unpack them."""

from __future__ import annotations

import random
import struct
from array import array

import pytest

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from rclpy.serialization import deserialize_message, serialize_message
from rotavg_msgs.msg import KeyframeReference, RelativeRotation, RelativeRotationArray
from std_msgs.msg import Header

from rotavg_ros.inputs import EDGE_CONVERTERS, Source
from rotavg_ros.online import RejectReason
from rotavg_ros.ros.node.intake.serialized_array import SerializedArray


def some_edges(number: int) -> RelativeRotationArray:
    """With names of all lengths, so that all alignments occur."""
    draw = random.Random(number)

    def name() -> str:
        return "".join(draw.choice("ab/_ß語") for _ in range(draw.randrange(9)))

    def end() -> KeyframeReference:
        stamp = Time(sec=draw.randrange(-10, 2**31), nanosec=draw.randrange(10**9))
        return KeyframeReference(by=draw.randrange(2), robot=name(), id=draw.randrange(2**64), stamp=stamp)

    def edge() -> RelativeRotation:
        x, y, z, w = (draw.uniform(-1, 1) for _ in range(4))
        return RelativeRotation(
            header=Header(stamp=Time(sec=draw.randrange(2**31)), frame_id=name()),
            id=draw.randrange(2**64),
            sequence=draw.randrange(2**32),
            source=end(),
            target=end(),
            rotation=Quaternion(x=x, y=y, z=z, w=w),
            precision=draw.choice((0.0, 1e300, float("inf"))),
            translation=[draw.uniform(-9, 9) for _ in range(draw.choice((0, 3)))],
            translation_precision=draw.uniform(0, 9),
            kind=draw.randrange(256),
        )

    return RelativeRotationArray(header=Header(frame_id=name()), edges=[edge() for _ in range(number)])


def plain(message: object) -> object:
    """Fields and their values, of a message or what stands for one."""
    names = getattr(message, "_fields", None) or getattr(message, "get_fields_and_field_types", dict)()
    if isinstance(message, (list, array)):
        return list(message)
    return {name: plain(getattr(message, name)) for name in names} if names else message


@pytest.mark.parametrize("number", [0, 1, 2, 50])
def test_what_is_read_is_what_rclpy_unpacks(number: int) -> None:
    serialized = serialize_message(some_edges(number))
    expected = deserialize_message(serialized, RelativeRotationArray)
    read = SerializedArray(serialized, RelativeRotationArray)
    assert plain(read.header) == plain(expected.header)
    assert [plain(edge) for edge in read.edges] == [plain(edge) for edge in expected.edges]


def test_edges_of_it_are_converted_as_those_of_a_message() -> None:
    convert = EDGE_CONVERTERS["rotavg_msgs/msg/RelativeRotationArray"](Source("a"))
    serialized = serialize_message(some_edges(50))
    expected = list(convert(deserialize_message(serialized, RelativeRotationArray)))
    assert list(convert(SerializedArray(serialized, RelativeRotationArray))) == expected


def test_both_byte_orders_are_read_and_other_representations_are_left_to_rclpy(monkeypatch: pytest.MonkeyPatch) -> None:
    big = b"\x00\x00\x00\x00" + struct.pack(">iII4sI", 7, 9, 4, b"cam\0", 0)
    read = SerializedArray(big, RelativeRotationArray)
    assert (read.header.stamp.sec, read.header.stamp.nanosec, read.header.frame_id) == (7, 9, "cam")
    assert list(read.edges) == []
    other = b"\x00\x07" + serialize_message(some_edges(2))[2:]
    monkeypatch.setattr("rotavg_ros.ros.node.intake.serialized_array.deserialize_message", lambda *_: some_edges(2))
    assert [plain(edge) for edge in SerializedArray(other, RelativeRotationArray).edges] == [
        plain(edge) for edge in some_edges(2).edges
    ]


@pytest.mark.parametrize("kept", [0.0, 0.01, 0.6])
@pytest.mark.parametrize("representation", [b"\x00\x01", b"\x00\x07"])
def test_a_message_that_ends_too_early_is_refused_and_not_nonsense(kept: float, representation: bytes) -> None:
    """As of a sender that was built with another definition; it had ended in a traceback, and counted nowhere."""
    serialized = representation + serialize_message(some_edges(3))[2:]
    convert = EDGE_CONVERTERS["rotavg_msgs/msg/RelativeRotationArray"](Source("a"))
    records = list(convert(SerializedArray(serialized[: round(kept * len(serialized))], RelativeRotationArray)))
    assert records[-1].edge is RejectReason.MALFORMED_MESSAGE
    assert len(records) <= 2 and all(record.edge is not RejectReason.MALFORMED_MESSAGE for record in records[:-1])
