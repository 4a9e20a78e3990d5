"""Message types and converters for entries of the topic parameters, ``topic`` or ``topic:package/msg/Type``.

A package is imported only when a topic asks for one of its types.
"""

from __future__ import annotations

import importlib
from dataclasses import dataclass

from rotavg_ros.errors import UserError
from rotavg_ros.inputs import EDGE_CONVERTERS, ODOMETRY_CONVERTERS, EdgeConverter, OdometryConverter, Source

DEFAULT_EDGE_TYPE = "rotavg_msgs/msg/RelativeRotation"
_EDGE_ARRAY_TYPE = "rotavg_msgs/msg/RelativeRotationArray"
DEFAULT_ODOMETRY_TYPE = "nav_msgs/msg/Odometry"


class AdapterError(UserError):
    """A topic whose message type cannot be used; the message names it."""


@dataclass(frozen=True)
class EdgeTopic:
    """An entry of the parameter ``edge_topics``, ready to subscribe to."""

    topic: str
    type_name: str
    message_type: type
    convert: EdgeConverter

    @property
    def element_type(self) -> type:
        """Message type of the edges in an array message."""
        return _message_type("edge", self.topic, DEFAULT_EDGE_TYPE)

    @property
    def is_array(self) -> bool:
        """Whether messages may have very many edges and are therefore taken as bytes (:class:`SerializedArray`)."""
        return self.type_name == _EDGE_ARRAY_TYPE


@dataclass(frozen=True)
class OdometryTopic:
    """An entry of the parameter ``odometry_topics``, ready to subscribe to."""

    topic: str
    type_name: str
    message_type: type
    convert: OdometryConverter


def edge_topic(entry: str, source: Source) -> EdgeTopic:
    """Find the message type of an entry and make a converter for its source.

    Raises:
        AdapterError: a type that has no converter, or whose package is not installed.
    """
    topic, type_name = split(entry, DEFAULT_EDGE_TYPE)
    if type_name not in EDGE_CONVERTERS:
        raise _unknown("edge", entry, type_name, list(EDGE_CONVERTERS))
    return EdgeTopic(topic, type_name, _message_type("edge", entry, type_name), EDGE_CONVERTERS[type_name](source))


def odometry_topic(entry: str) -> OdometryTopic:
    """Find the message type and the converter of an entry.

    Raises:
        AdapterError: a type that has no converter, or whose package is not installed.
    """
    topic, type_name = split(entry, DEFAULT_ODOMETRY_TYPE)
    if type_name not in ODOMETRY_CONVERTERS:
        raise _unknown("odometry", entry, type_name, list(ODOMETRY_CONVERTERS))
    message_type = _message_type("odometry", entry, type_name)
    return OdometryTopic(topic, type_name, message_type, ODOMETRY_CONVERTERS[type_name])


def split(entry: str, default_type: str) -> tuple[str, str]:
    """Topic and type name of an entry.

    Raises:
        AdapterError: no topic.
    """
    topic, _, type_name = entry.partition(":")
    if not topic:
        raise AdapterError(f"{entry!r} names no topic; write topic or topic:package/msg/Type")
    return topic, type_name or default_type


def _unknown(what: str, entry: str, type_name: str, known: list[str]) -> AdapterError:
    return AdapterError(f"{what} topic {entry!r}: no adapter for {type_name}; known are {', '.join(known)}")


def _message_type(what: str, entry: str, type_name: str) -> type:
    package, _, name = type_name.split("/")
    try:
        message_type: type = getattr(importlib.import_module(f"{package}.msg"), name)
    except (ImportError, AttributeError) as error:
        raise AdapterError(f"{what} topic {entry!r} needs {type_name}: install the package {package}") from error
    return message_type
