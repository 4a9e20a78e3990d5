"""The node as a fork of a process that has imported what it needs.

Dozens of tests start a node, and torch takes each two seconds of a core to import. What a fork runs is the executable's
``main``, in a process of its own; the executable itself is what the demo, the packaging's tests and others start.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from multiprocessing import get_context
from pathlib import Path

_IMPORTED = [
    "numba",
    "rclpy",
    "rotavg_ros.ros.node.estimator_node",
    "rotavg_ros.online.solver_process.server",
    "rotavg_ros.solver.pipeline",
]
# Where libraries and modules are found is settled when a process starts.
_PATHS = ("AMENT_PREFIX_PATH", "LD_LIBRARY_PATH", "PYTHONPATH")


def _paths() -> list[str | None]:
    return [os.environ.get(name) for name in _PATHS]


_PATHS_HERE = _paths()


def can_fork() -> bool:
    """Whether a fork would find the same libraries and modules as a process that is started now."""
    return _paths() == _PATHS_HERE


class ForkedNode:
    """A node that was given some words, with the parts of :class:`subprocess.Popen` that tests use."""

    def __init__(self, words: Sequence[str], output: Path) -> None:
        context = get_context("forkserver")
        context.set_forkserver_preload(_IMPORTED)
        self._process = context.Process(target=_run_node, args=([*words], output, {**os.environ}))
        self._process.start()

    @property
    def pid(self) -> int:
        assert self._process.pid is not None
        return self._process.pid

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float) -> int:
        self._process.join(timeout)
        code = self._process.exitcode
        if code is None:
            raise subprocess.TimeoutExpired("rotavg_node", timeout)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            os.kill(self.pid, number)


def _run_node(words: list[str], output: Path, environment: dict[str, str]) -> None:
    os.environ.clear()
    os.environ.update(environment)
    sink = os.open(output, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(sink, stream.fileno())
    os.close(sink)
    sys.argv = ["rotavg_node", *words]
    from rotavg_ros.ros.node.main import main

    sys.exit(main())
