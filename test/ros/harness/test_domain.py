"""A domain in which a node listens, or that somebody has claimed, is not given to another."""

from __future__ import annotations

import subprocess
import sys

import pytest

rclpy = pytest.importorskip("rclpy")
from rotavg_ros.ros.harness.domain import claim_domain_id

pytestmark = pytest.mark.ros


def claimed_by_another_process(candidates: str = "") -> int:
    """The domain that a process gets which asks for one of these and ends."""
    script = f"from rotavg_ros.ros.harness.domain import claim_domain_id; print(claim_domain_id({candidates}))"
    command = [sys.executable, "-W", "error", "-c", script]
    ended = subprocess.run(command, capture_output=True, text=True, check=True)
    assert ended.stderr == ""  # no warning of a socket that is open at the end
    return int(ended.stdout)


def test_a_node_makes_its_domain_unfree() -> None:
    unclaimed = claimed_by_another_process()
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=unclaimed)
    node = rclpy.create_node("anybody", context=context)
    try:
        with pytest.raises(RuntimeError, match="in use"):
            claim_domain_id([unclaimed])
    finally:
        node.destroy_node()
        rclpy.shutdown(context=context)


def test_a_claimed_domain_goes_to_nobody_else() -> None:
    # Nothing listens there yet: a demo and a test that begins later once chose the same domain so.
    claimed = claim_domain_id()
    with pytest.raises(RuntimeError, match="in use"):
        claim_domain_id([claimed])
    assert claimed_by_another_process(f"[{claimed}, *range(1, 102)]") != claimed
