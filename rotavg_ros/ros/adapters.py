"""Which messages can carry edges: type names to converters, loaded only when a topic asks for them."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from rotavg_ros.errors import UserError
from rotavg_ros.online import EdgeMeasurement
from rotavg_ros.online.measurements import RejectedInputError, RejectReason
from rotavg_ros.online.quaternion import Quaternion

DEFAULT_TYPE = "rotavg_msgs/msg/RelativeRotation"


class AdapterError(UserError):
    """An edge topic whose message type cannot be used; the message names it."""


@dataclass(frozen=True, slots=True)
class EdgeRecord:
    """One edge of a message.

    Attributes:
        edge: the measurement, or why it cannot be read.
        sender, sequence: who counts, and the count; 0 for senders that do not.
    """

    edge: EdgeMeasurement | RejectReason
    sender: str
    sequence: int


# message, default robot, body_from_sensor → its edges
Converter = Callable[[Any, str, Quaternion], Iterator[EdgeRecord]]


@dataclass(frozen=True)
class EdgeTopic:
    """An entry of the parameter ``edge_topics``, ready to subscribe to."""

    topic: str
    type_name: str
    message_type: type
    convert: Converter


def _single(message: Any, default_robot: str, body_from_sensor: Quaternion) -> Iterator[EdgeRecord]:
    from rotavg_ros.ros.conversions import edge_from_message

    try:
        edge: EdgeMeasurement | RejectReason = edge_from_message(message, default_robot, body_from_sensor)
    except RejectedInputError as rejection:
        edge = rejection.reason
    yield EdgeRecord(edge, message.source.robot, message.sequence)


def _array(message: Any, default_robot: str, body_from_sensor: Quaternion) -> Iterator[EdgeRecord]:
    for edge in message.edges:
        yield from _single(edge, default_robot, body_from_sensor)


CONVERTERS: dict[str, Converter] = {
    DEFAULT_TYPE: _single,
    "rotavg_msgs/msg/RelativeRotationArray": _array,
}


def load(entry: str) -> EdgeTopic:
    """Find the message type and the converter of 'topic' or 'topic:package/msg/Type'.

    Raises:
        AdapterError: a type that has no converter, or whose package is not installed.
    """
    topic, _, type_name = entry.partition(":")
    type_name = type_name or DEFAULT_TYPE
    if not topic:
        raise AdapterError(f"edge topic {entry!r} names no topic; write topic or topic:package/msg/Type")
    if type_name not in CONVERTERS:
        raise AdapterError(f"edge topic {entry!r}: no adapter for {type_name}; known are {', '.join(CONVERTERS)}")
    package, _, name = type_name.split("/")
    try:
        message_type = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise AdapterError(f"edge topic {entry!r} needs {type_name}: install the package {package}") from error
    return EdgeTopic(topic, type_name, message_type, CONVERTERS[type_name])
