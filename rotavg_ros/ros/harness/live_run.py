"""A bag played to the installed node, each in its own process, and what the node made of it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import AbstractContextManager, suppress
from functools import cache
from pathlib import Path
from typing import BinaryIO

from ament_index_python.packages import PackageNotFoundError, get_package_prefix

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.node_answer import NodeAnswer
from rotavg_ros.ros.harness.domain import free_domain_id
from rotavg_ros.ros.harness.recorder import Recorder

_START_TIMEOUT_S = 60.0
_REST_TIMEOUT_S = 180.0
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
    """Let this process and those it starts talk among themselves only: own domain, no network; once for all."""
    os.environ["ROS_AUTOMATIC_DISCOVERY_RANGE"] = "LOCALHOST"
    os.environ["ROS_DOMAIN_ID"] = str(free_domain_id())


def play_to_node(
    bag: Path,
    parameters: dict[str, str],
    *,
    rate: float,
    topics: list[str],
    log: Path,
    waiting: Callable[[str], AbstractContextManager[None]],
) -> NodeAnswer:
    """Start the node, play the bag to it, wait until it is at rest, and stop it.

    Args:
        bag: what to play.
        parameters: of the node, by name.
        rate: times real time.
        topics: of the bag.
        log: file for what the node and the player print.
        waiting: shows that something takes its time.

    Raises:
        LiveRunError: the node died or gave no answer; the message has its last words.
    """
    settings = [word for name, value in parameters.items() for word in ("-p", f"{name}:={value}")]
    with log.open("wb") as sink, Recorder() as recorder:
        node = subprocess.Popen(
            [installed_node(), "--ros-args", *settings], stdin=subprocess.DEVNULL, stdout=sink, stderr=subprocess.STDOUT
        )
        try:
            with waiting("starting the node"):
                _spin_until(recorder, lambda: recorder.hears_node, node, log, _START_TIMEOUT_S, "did not start")
            _play(bag, rate, topics, recorder, node, log, sink)
            recorder.forget_reports()
            with waiting("waiting for the last answer"):
                _spin_until(recorder, lambda: recorder.is_at_rest, node, log, _REST_TIMEOUT_S, "did not come to rest")
            answer = recorder.answer()
            exit_code = stop_process(node)
        finally:
            stop_process(node)
    if exit_code != 0:
        raise LiveRunError(f"the node ended with exit code {exit_code}; {_last_words(log)}")
    if answer is None or len(answer.keyframe_ids) == 0:
        raise LiveRunError(f"the node gave no answer; {_last_words(log)}")
    return answer


def _play(
    bag: Path,
    rate: float,
    topics: list[str],
    recorder: Recorder,
    node: subprocess.Popen[bytes],
    log: Path,
    sink: BinaryIO,
) -> None:
    command = [sys.executable, "-m", "rotavg_ros.cli.main", "play", str(bag), "--rate", str(rate), "--topics", *topics]
    # Ctrl-C reaches the player as well; what it says then is for the log.
    player = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=sink)
    try:
        while player.poll() is None:
            recorder.spin(0.2)
            _check_alive(node, log)
    finally:
        stop_process(player)
    if player.returncode != 0:
        raise LiveRunError(f"playing the bag failed with exit code {player.returncode}; {_last_words(log)}")


def _spin_until(
    recorder: Recorder,
    condition: Callable[[], bool],
    node: subprocess.Popen[bytes],
    log: Path,
    timeout_s: float,
    failure: str,
) -> None:
    deadline = time.monotonic() + timeout_s
    while not condition():
        recorder.spin(0.1)
        _check_alive(node, log)
        if time.monotonic() > deadline:
            raise LiveRunError(f"the node {failure} within {timeout_s:.0f} s; {_last_words(log)}")


def _check_alive(node: subprocess.Popen[bytes], log: Path) -> None:
    if node.poll() is not None:
        raise LiveRunError(f"the node died with exit code {node.returncode}; {_last_words(log)}")


def stop_process(process: subprocess.Popen[bytes]) -> int:
    """End one process that we started, gently if it can be; returns its exit code."""
    for how in (signal.SIGINT, signal.SIGTERM, signal.SIGKILL):
        if process.poll() is not None:
            break
        process.send_signal(how)
        with suppress(subprocess.TimeoutExpired):
            process.wait(_EXIT_TIMEOUT_S)
    return process.wait()


def _last_words(log: Path) -> str:
    lines = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()
    return f"its last words in {log}: {lines[-1].strip()}" if lines else f"it printed nothing ({log})"
