"""Fixtures for tests that start executables as processes of their own and talk to them over DDS."""

from __future__ import annotations

import contextlib
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

rclpy = pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")

STARTUP_SECONDS = 30.0  # far more than needed: a loaded machine must not fail a test


class RunningProcess:
    """An executable that a test started, with everything it printed."""

    def __init__(self, command: list[str | Path], output_file: Path) -> None:
        self._output_file = output_file
        with output_file.open("wb") as sink:
            self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def is_running(self) -> bool:
        return self._process.poll() is None

    @property
    def output(self) -> str:
        """What it printed so far, on stdout and stderr together."""
        return self._output_file.read_text(encoding="utf-8", errors="replace")

    def wait(self, timeout: float = STARTUP_SECONDS) -> int:
        """Wait for its own end; returns the exit code."""
        return self._process.wait(timeout)

    def stop(self, how: signal.Signals = signal.SIGINT, timeout: float = STARTUP_SECONDS) -> int:
        """Send a signal to it alone and wait for its end; returns the exit code."""
        if self.is_running:
            self._process.send_signal(how)
        return self.wait(timeout)

    def end_for_sure(self) -> None:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self.stop(signal.SIGTERM, timeout=5.0)
        if self.is_running:
            self.stop(signal.SIGKILL)


@pytest.fixture
def start_process(tmp_path: Path) -> Iterator[Callable[..., RunningProcess]]:
    """A function that starts a command, given as its words; whatever it started is ended after the test."""
    started: list[RunningProcess] = []

    def start(*command: str | Path) -> RunningProcess:
        process = RunningProcess(list(command), tmp_path / f"process_{len(started)}.txt")
        started.append(process)
        return process

    yield start
    for process in started:
        process.end_for_sure()


@pytest.fixture
def probe_node() -> Iterator[rclpy.node.Node]:
    """A node of the test's own, to publish, subscribe and look around with."""
    context = rclpy.Context()
    rclpy.init(context=context)
    node = rclpy.create_node("test_probe", context=context)
    yield node
    node.destroy_node()
    rclpy.shutdown(context=context)


@pytest.fixture
def wait_until() -> Callable[..., None]:
    """A function that waits for a condition while a process runs, and fails with its output if it ends before."""

    def wait(
        condition: Callable[[], bool], process: RunningProcess | None = None, timeout: float = STARTUP_SECONDS
    ) -> None:
        deadline = time.monotonic() + timeout
        while not condition():
            if process is not None and not process.is_running:
                pytest.fail(f"the process ended with {process.wait()}:\n{process.output}")
            if time.monotonic() > deadline:
                pytest.fail(f"waited {timeout} s in vain" + (f":\n{process.output}" if process else ""))
            time.sleep(0.05)

    return wait
