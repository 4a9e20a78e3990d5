"""A domain in which a node listens is not taken for free."""

from __future__ import annotations

import os

import pytest

rclpy = pytest.importorskip("rclpy")
from rotavg_ros.ros.harness.domain import free_domain_id

pytestmark = pytest.mark.ros


def test_a_node_makes_its_domain_unfree() -> None:
    here = int(os.environ["ROS_DOMAIN_ID"])
    assert free_domain_id([here]) == here
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=here)
    node = rclpy.create_node("anybody", context=context)
    try:
        with pytest.raises(RuntimeError, match="in use"):
            free_domain_id([here])
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)
