"""Quality of service, robots' names in topic names, and one-line errors about topics."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from rotavg_ros.errors import UserError, in_one_line

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# Prefixes that ROS allows before a topic's name.
_PREFIX = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*/)+")


def checked_prefixes(prefixes: Mapping[str, str]) -> Mapping[str, str]:
    """The prefixes of the robots' topics (:meth:`NodeParameters.prefixes`), checked.

    Raises:
        UserError: a name cannot be part of a topic's.
    """
    for robot, prefix in prefixes.items():
        if prefix and not _PREFIX.fullmatch(prefix):
            raise UserError(
                f"robots names {robot!r}, which cannot be part of a topic's name: use letters, digits and _, and no "
                "digit first but in a number"
            )
    return prefixes


def overrides() -> QoSOverridingOptions:
    """History, depth and reliability may be set by ``qos_overrides.<topic>…`` parameters."""
    return QoSOverridingOptions.with_default_policies()


@contextmanager
def user_error_about(topic: str) -> Iterator[None]:
    """Turn rclpy's errors about a topic's name or ``qos_overrides`` into one-line user errors."""
    try:
        yield
    except Exception as error:  # rclpy has a different type for every mistake
        raise UserError(f"topic {topic}: {in_one_line(error)}") from error


def publisher(node: Node, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
    """A publisher whose quality of service the user may override.

    rclpy writes overrides into the profile that it is given, so it gets a copy.

    Raises:
        UserError: an invalid topic name or ``qos_overrides``.
    """
    with user_error_about(topic):
        return node.create_publisher(message_type, topic, copy(qos), qos_overriding_options=overrides())
