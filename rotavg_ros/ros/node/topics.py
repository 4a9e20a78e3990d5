"""Quality of service, and mistakes about topics in one line."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.qos_overriding_options import QoSOverridingOptions

from rotavg_ros.errors import UserError

LATCHED = QoSProfile(depth=1, reliability=ReliabilityPolicy.RELIABLE, durability=DurabilityPolicy.TRANSIENT_LOCAL)


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

    Raises:
        UserError: the topic's name or its ``qos_overrides`` cannot be.
    """
    with user_error_about(topic):
        return node.create_publisher(message_type, topic, qos, qos_overriding_options=overrides())
