"""The `rotavg` command. A subcommand's code is imported when it runs, so that help and mistakes come at once."""

from __future__ import annotations

import argparse
import importlib
import io
import os
import re
import sys
from collections.abc import Sequence
from contextlib import nullcontext
from typing import Any, NamedTuple, NoReturn

from rotavg_ros.cli.command_line import command_line
from rotavg_ros.cli.interruption import Interruption
from rotavg_ros.cli.progress import working
from rotavg_ros.errors import UserError, is_interruption
from rotavg_ros.startup import leave_to_the_system, loading
from rotavg_ros.version import __version__


class Command(NamedTuple):
    """A subcommand.

    Its options are in the module of :mod:`rotavg_ros.cli.options` of the same name: a docstring for ``--help``, and
    ``add_arguments(parser)``. ``module`` has ``run(arguments) -> exit code``; besides the options, ``arguments`` has
    ``command_line``, the whole command as it can be typed again, for reports.
    """

    name: str
    module: str
    help: str


COMMANDS = (
    Command("solve", "rotavg_ros.cli.solve", "solve view-graph files (g2o, TORO, iSAM, 1DSfM, npz, Lund)"),
    Command("demo", "rotavg_ros.cli.demo", "play a simulated run, or your graph, to the live node"),
    Command("simulate", "rotavg_ros.cli.simulate", "simulate a robot's run and write it as a bag"),
    Command("convert", "rotavg_ros.cli.convert", "convert view-graphs between files and bags"),
    Command("play", "rotavg_ros.cli.play", "publish a bag's messages live"),
    Command("replay", "rotavg_ros.cli.replay", "replay a recorded bag without ROS, with a report"),
    Command("train", "rotavg_ros.cli.train", "train the networks"),
    Command("evaluate", "rotavg_ros.cli.evaluate", "compare the methods in tables and pictures"),
    Command("benchmark", "rotavg_ros.cli.benchmark", "time the solver beside COLMAP and GTSAM, the node under load"),
    Command("plot", "rotavg_ros.cli.plot", "draw the statistics of a view-graph's noise, or of training"),
)


class UsageError(UserError):
    """Words on the command line that are not a valid command."""


class PrintError(UserError):
    """Standard output that cannot be written, as on a full disk."""


class _Parser(argparse.ArgumentParser):
    """Reports mistakes in one line, and accepts an optional last positional argument anywhere, and numbers like -1e-3.

    Before Python 3.13, argparse assumes that such an argument was left out if an option comes before it, and before
    3.14 that such a number is an option.
    """

    _between_options = False

    def __init__(self, *args: Any, **kwargs: Any) -> None:
        super().__init__(*args, **kwargs)
        self._negative_number_matcher = re.compile(r"-(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?$")

    def parse_known_args(self, args=None, namespace=None):  # type: ignore[no-untyped-def]
        """As in :class:`argparse.ArgumentParser`."""
        may_be_left_out = any(action.nargs == "?" and not action.option_strings for action in self._actions)
        if self._between_options or not may_be_left_out:
            return super().parse_known_args(args, namespace)
        self._between_options = True
        try:
            return self.parse_known_intermixed_args(args, namespace)
        finally:
            self._between_options = False

    def error(self, message: str) -> NoReturn:
        raise UsageError(f"{message}; see {self.prog} --help")


EXIT_USER_ERROR = 2
EXIT_INTERRUPTED = 130  # 128 + SIGINT, as in shells
EXIT_NOBODY_READS = 141  # 128 + SIGPIPE


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one subcommand.

    Args:
        arguments: the words after ``rotavg``; default: those of this process.

    Returns:
        The exit code: 0, or 2 for a mistake in what the user gave (one line on stderr), or 130 after Ctrl-C (143 after
        SIGTERM, 129 after SIGHUP), whether or not what was done by then is written. 141 if the reader of what is
        printed has closed it: the command may have ended early.
    """
    try:
        try:
            return _run(arguments)
        finally:
            _print_the_rest()
    except BrokenPipeError:  # `| head`
        _discard_prints()
        return EXIT_NOBODY_READS
    except PrintError as error:
        print_error(error)
        return EXIT_USER_ERROR


def _run(arguments: Sequence[str] | None) -> int:
    is_own_process = arguments is None
    interruption = Interruption(is_own_process)
    arguments = sys.argv[1:] if arguments is None else list(arguments)
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="backslashreplace")  # a terminal without UTF-8, a file name without encoding
    try:
        parsed = parse(arguments)
        module = next(command.module for command in COMMANDS if command.name == parsed.command)
        with working("loading"), loading() if is_own_process else nullcontext():
            run = importlib.import_module(module).run
        interruption.has_loaded()
        exit_code: int = run(parsed)
        return exit_code or interruption.exit_code
    except UserError as error:
        print_error(error)
        return EXIT_USER_ERROR
    except (KeyboardInterrupt, SystemError) as error:
        if not is_interruption(error):
            raise
        print("rotavg: interrupted", file=sys.stderr)
        return interruption.exit_code or EXIT_INTERRUPTED
    finally:
        if is_own_process:
            leave_to_the_system()


def _print_the_rest() -> None:
    """Write out what stdout has buffered, while an error can still be told.

    Raises:
        BrokenPipeError: nobody reads it.
        PrintError: it cannot be written.
    """
    try:
        if sys.stdout is not None:  # closed by the caller
            sys.stdout.flush()
    except BrokenPipeError:
        raise
    except OSError as error:
        _discard_prints()
        raise PrintError(f"what is printed cannot be written: {error.strerror or error}") from None


def _discard_prints() -> None:
    """Python would complain again when it closes stdout."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def print_error(error: UserError) -> None:
    """Print a user's mistake in one line."""
    print(f"rotavg: error: {error}", file=sys.stderr)


def print_warning(warning: str) -> None:
    """Print a warning in one line."""
    print(f"rotavg: warning: {warning}", file=sys.stderr)


def parse(arguments: Sequence[str]) -> argparse.Namespace:
    """Parse the words after ``rotavg``; adds ``command`` and ``command_line`` to the options (see :class:`Command`).

    Raises:
        UsageError: they are not a valid command.
    """
    # Only the chosen subcommand gets its arguments; the others are known by name and one line of help.
    chosen = next((word for word in arguments if not word.startswith("-")), None)
    parser = _Parser(
        prog="rotavg", description="Rotation averaging with outlier rejection, for files, bags and robots."
    )
    parser.add_argument("--version", action="version", version=f"rotavg {__version__}")
    subparsers = parser.add_subparsers(dest="command", metavar="COMMAND", required=True)
    for command in COMMANDS:
        subparser = subparsers.add_parser(command.name, help=command.help)
        if command.name == chosen:
            options = importlib.import_module(f"rotavg_ros.cli.options.{command.name}")
            subparser.description = (options.__doc__ or command.help).strip()
            subparser.formatter_class = argparse.RawDescriptionHelpFormatter
            options.add_arguments(subparser)
    parsed: argparse.Namespace
    parsed, unknown = parser.parse_known_args(arguments)  # type: ignore[no-untyped-call]
    if unknown:
        subparsers.choices[parsed.command].error(f"unrecognized arguments: {' '.join(unknown)}")
    parsed.command_line = command_line(parser, parsed)
    return parsed


if __name__ == "__main__":
    sys.exit(main())
