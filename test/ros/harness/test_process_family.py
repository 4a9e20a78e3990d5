"""What a process and its children take, beside what they say of themselves."""

from __future__ import annotations

import os
import subprocess
import sys

import pytest

pytest.importorskip("rclpy")  # the folder's __init__ is ROS's

from rotavg_ros.ros.harness.process_family import children, cpu_seconds, memory_mb, peak_memory_mb

_CHILD = """
import sys, time
memory = bytearray(50_000_000)
while time.process_time() < 0.5: pass
print(time.process_time(), flush=True)
sys.stdin.read()
"""


def test_a_child_counts_as_it_counts_itself() -> None:
    before = sum(os.times()[:2])
    with subprocess.Popen(
        [sys.executable, "-c", _CHILD], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        seconds = float(child.stdout.readline())
        assert child.pid in children(os.getpid())
        assert cpu_seconds(child.pid) == pytest.approx(seconds, abs=0.05)
        assert 50 < peak_memory_mb(child.pid) < 100  # what it holds, and an interpreter
        assert memory_mb(child.pid) < peak_memory_mb(child.pid) + 1  # libraries are others', too
        assert memory_mb(os.getpid()) > memory_mb(child.pid) > 50
        assert cpu_seconds(os.getpid()) > before + 0.4
    assert peak_memory_mb(child.pid) == memory_mb(child.pid) == 0.0 and child.pid not in children(os.getpid())
