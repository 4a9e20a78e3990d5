"""The process of the node: arguments, signals, the executor's loop, and a clean end in every case."""

from __future__ import annotations

import os
import signal
import sys
import traceback
from types import FrameType
from typing import TYPE_CHECKING

from rotavg_ros.errors import UserError, in_one_line
from rotavg_ros.startup import loading

if TYPE_CHECKING:
    from rotavg_ros.online.solver_process.process import ServerProcess

# Signals do not interrupt the executor's wait, so it must be short.
_LONGEST_WAIT_S = 0.1
_PATIENCE_AT_EXIT_S = 1.0
_LOG_PERIOD_S = 5.0

USAGE = """usage: rotavg_node [--print-parameters] [--ros-args [-p NAME:=VALUE] [--params-file FILE] [-r __ns:=/NS] ...]

Keeps a robot's orientations right: odometry and relative rotations in, absolute orientations and outlier flags out.
--print-parameters writes all parameters with their defaults as a file for `--ros-args --params-file`."""


def main() -> int:
    """Run the node until SIGINT, SIGTERM or SIGHUP; returns the exit code, 2 for a mistake of the user."""
    stop = _StopSignal()  # before the imports below, which take seconds
    try:
        import rclpy
        from rclpy.signals import SignalHandlerOptions
        from rclpy.utilities import remove_ros_args, try_shutdown
    except ModuleNotFoundError as error:
        return _fail_without(error)
    try:
        arguments = remove_ros_args(sys.argv)[1:]
        if arguments:
            return _answer_arguments(arguments)
        process = _solver_process()
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    except ModuleNotFoundError as error:
        return _fail_without(error)
    except Exception as error:  # rclpy has no common type for bad arguments and parameter files
        return _fail(f"{in_one_line(error)}; see rotavg_node --help")
    try:
        return _run(stop, process)
    finally:
        try_shutdown()


class _StopSignal:
    """SIGINT, SIGTERM and SIGHUP end the process at once while it starts; later they request the end.

    SIGHUP comes when the terminal closes; under ``nohup`` it is ignored.
    """

    def __init__(self) -> None:
        self.requested = False
        self._starting = True
        for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
            if number != signal.SIGHUP or signal.getsignal(number) != signal.SIG_IGN:
                signal.signal(number, self._request)

    def has_started(self) -> None:
        """From now on there is something to clean up at the end."""
        self._starting = False

    def _request(self, _number: int, _frame: FrameType | None) -> None:
        if self._starting:
            os._exit(0)  # perhaps in the middle of an import; there is nothing to clean up yet
        self.requested = True


def _solver_process() -> ServerProcess:
    """A fork of this process that solves, made while there are no threads, so that both share torch."""
    with loading():
        import torch  # noqa: F401 - loaded before the fork

        from rotavg_ros.online.solver_process.process import Forked
    return Forked()


def _run(stop: _StopSignal, process: ServerProcess) -> int:
    try:
        with loading():
            from rclpy.executors import SingleThreadedExecutor

            from rotavg_ros.ros.node.estimator_node import RotavgNode
    except ModuleNotFoundError as error:
        return _fail_without(error)
    executor = SingleThreadedExecutor()
    try:
        # Only from when the node locks its state file is there something to clean up; its warm-up takes seconds.
        node = RotavgNode(executor, process, stop.has_started)
    except UserError as error:
        return _fail(str(error))
    executor.add_node(node)
    while not stop.requested:
        try:
            executor.spin_once(timeout_sec=_LONGEST_WAIT_S)
        except Exception:  # a correction node that dies takes the robot with it
            node.get_logger().error(traceback.format_exc(), throttle_duration_sec=_LOG_PERIOD_S)
    if not node.close(_PATIENCE_AT_EXIT_S):
        # A long solve cannot be interrupted, and Python must not shut down around it.
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(0)
    executor.shutdown()
    node.destroy_node()
    return 0


def _answer_arguments(arguments: list[str]) -> int:
    if arguments == ["--print-parameters"]:
        from rotavg_ros.settings.parameters import NodeParameters
        from rotavg_ros.settings.text import to_yaml

        print(to_yaml(NodeParameters()), end="")
        return 0
    if arguments in (["-h"], ["--help"]):
        print(USAGE)
        return 0
    return _fail(f"unknown argument {arguments[0]}; see rotavg_node --help")


def _fail_without(error: ModuleNotFoundError) -> int:
    """Report a missing package that comes with ROS 2 or with the build of this workspace."""
    package = (error.name or "").partition(".")[0]
    return _fail(
        f"there is no Python package {package}; source ROS 2's setup.sh and this workspace's install/setup.sh, or "
        "run `make setup`, which installs what it needs without ROS 2"
    )


def _fail(message: str) -> int:
    print(f"rotavg_node: error: {message}", file=sys.stderr)
    return 2


if __name__ == "__main__":
    sys.exit(main())
