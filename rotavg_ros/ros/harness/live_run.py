"""A bag played to the installed node, each in its own process, and what the node made of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import BinaryIO

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.live.node_answer import NodeAnswer
from rotavg_ros.ros.harness.domain import claim_domain_id
from rotavg_ros.ros.harness.recorder import Recorder

# Seconds, on a machine that is slow or busy: the first answer alone may take 300, once on a machine, for compiling.
_START_TIMEOUT_S = 150.0
_REST_TIMEOUT_S = 600.0
_EXIT_TIMEOUT_S = 10.0


class LiveRunError(UserError):
    """The node is not installed, died, or gave no answer."""


def installed_node() -> Path:
    """The node's executable, where ``ros2 run rotavg_ros rotavg_node`` finds it.

    Raises:
        LiveRunError: the package is not installed for ROS 2.
    """
    try:
        executable = Path(get_package_prefix("rotavg_ros")) / "lib" / "rotavg_ros" / "rotavg_node"
    except PackageNotFoundError:
        raise LiveRunError(
            "the package rotavg_ros is not in the ament index; run `make setup`, or source the workspace's setup file"
        ) from None
    if not os.access(executable, os.X_OK):
        raise LiveRunError(f"{executable} is missing; build the workspace again (`make setup`)")
    return executable


@cache
def keep_to_this_machine() -> None:
    """Let this process and those it starts talk only among themselves: own domain, no network; takes effect once."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(claim_domain_id())


@dataclass(frozen=True)
class Playing:
    """What is played to the node.

    Attributes:
        bag: path of the bag.
        topics: topics of the bag to play.
        rate: multiple of real time.
    """

    bag: Path
    topics: list[str]
    rate: float


def play_to_node(
    playing: Playing,
    parameters: dict[str, str],
    log: Path,
    waiting: Callable[[str], AbstractContextManager[None]],
) -> NodeAnswer:
    """Start the node, play the bag to it, wait until it is at rest, and stop it.

    Args:
        playing: the bag, and how.
        parameters: of the node, by name.
        log: file for what the node and the player print.
        waiting: context that shows what is being waited for.

    Raises:
        LiveRunError: the node died or gave no answer; the message quotes its last output.
    """
    with log.open("wb") as sink, Recorder() as recorder:
        node = _StartedNode(parameters, log, sink)
        try:
            with waiting("starting the node"):
                node.spin_until(recorder, lambda: recorder.hears_node, _START_TIMEOUT_S, "did not start")
            _play(playing, recorder, node, sink)
            recorder.forget_reports()
            with waiting("waiting for the last answer"):
                node.spin_until(recorder, lambda: recorder.is_at_rest, _REST_TIMEOUT_S, "did not come to rest")
            answer = recorder.answer()
        finally:
            exit_code = node.stop()
    if exit_code != 0:
        raise LiveRunError(f"the node ended with exit code {exit_code}; {node.last_words()}")
    if answer is None or len(answer.keyframe_ids) == 0:
        raise LiveRunError(f"the node gave no answer; {node.last_words()}")
    return answer


class _StartedNode:
    """The installed node as a process that prints into a log."""

    def __init__(self, parameters: dict[str, str], log: Path, sink: BinaryIO) -> None:
        settings = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
        command = [str(installed_node()), "--ros-args", *settings]
        self._log = log
        self._process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT)

    def spin_until(self, recorder: Recorder, condition: Callable[[], bool], timeout_s: float, failure: str) -> None:
        """Listen until the condition holds.

        Raises:
            LiveRunError: the node died, or the time ran out; the message then includes ``failure``.
        """
        deadline = time.monotonic() + timeout_s
        while not condition():
            recorder.spin(0.1)
            self.check_alive()
            if time.monotonic() > deadline:
                raise LiveRunError(f"the node {failure} within {timeout_s:.0f} s; {self.last_words()}")

    def check_alive(self) -> None:
        """Raise a :class:`LiveRunError` if it has died."""
        if self._process.poll() is not None:
            raise LiveRunError(f"the node died with exit code {self._process.returncode}; {self.last_words()}")

    def stop(self) -> int:
        """End it; returns its exit code."""
        return stop_process(self._process)

    def last_words(self) -> str:
        """The last line that it, or the player, printed."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
        return f"its last words in {self._log}: {lines[-1].strip()}" if lines else f"it printed nothing ({self._log})"


def _play(playing: Playing, recorder: Recorder, node: _StartedNode, sink: BinaryIO) -> None:
    command = [sys.executable, "-m", "rotavg_ros.cli.main", "play", str(playing.bag), "--rate", str(playing.rate)]
    # Ctrl-C reaches the player as well; what it prints then goes to the log.
    player = subprocess.Popen(
        [*command, "--topics", *playing.topics], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=sink
    )
    try:
        while player.poll() is None:
            recorder.spin(0.2)
            node.check_alive()
    finally:
        stop_process(player)
    if player.returncode != 0:
        raise LiveRunError(f"playing the bag failed with exit code {player.returncode}; {node.last_words()}")


def stop_process(process: subprocess.Popen[bytes]) -> int:
    """End one process that we started, gently if possible; returns its exit code."""
    for how in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            break
        process.send_signal(how)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_EXIT_TIMEOUT_S)
    return process.wait()
