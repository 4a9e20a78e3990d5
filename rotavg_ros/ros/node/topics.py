"""Quality of service, robots' names in topics', and mistakes about topics in one line."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from copy import copy

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from rotavg_ros.errors import UserError

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)

# What ROS allows in front of a topic's name.
_PREFIX = re.compile(r"/?([A-Za-z_][A-Za-z0-9_]*/)+")


def checked_prefixes(prefixes: Mapping[str, str]) -> Mapping[str, str]:
    """What stands before the topics of each robot, as :meth:`NodeParameters.prefixes` has it.

    Raises:
        UserError: a name cannot be part of a topic's, or two robots would have the same topics.
    """
    robot_of: dict[str, str] = {}
    for robot, prefix in prefixes.items():
        if prefix and not _PREFIX.fullmatch(prefix):
            raise UserError(
                f"robots names {robot!r}, which cannot be part of a topic's name: use letters, digits and _, and no "
                "digit first but in a number"
            )
        other = robot_of.setdefault(prefix, robot)
        if other != robot:
            raise UserError(f"robots names {other!r} and {robot!r}, whose topics would both begin with {prefix}")
    return prefixes


def overrides() -> QoSOverridingOptions:
    """History, depth and reliability may be set by ``qos_overrides.<topic>…`` parameters."""
    return QoSOverridingOptions.with_default_policies()


@contextmanager
def user_error_about(topic: str) -> Iterator[None]:
    """What rclpy says about a topic's name or its ``qos_overrides``, in one line."""
    try:
        yield
    except Exception as error:  # rclpy has a different type for every mistake
        raise UserError(f"topic {topic}: {' '.join(str(error).split())}") from error


def publisher(node: Node, message_type: type, topic: str, qos: QoSProfile) -> Publisher:
    """A publisher whose quality of service the user may override.

    rclpy writes an override into the profile that it is given, so it gets one of its own.

    Raises:
        UserError: the topic's name or its ``qos_overrides`` cannot be.
    """
    with user_error_about(topic):
        return node.create_publisher(message_type, topic, copy(qos), qos_overriding_options=overrides())
