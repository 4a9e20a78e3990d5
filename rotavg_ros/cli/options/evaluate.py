"""Compare the methods; write tables (Markdown, CSV) and pictures (PNG) of what comes out."""

from __future__ import annotations

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from rotavg_ros.cli.arguments import positive_number, positive_whole_number, thread_count, whole_number
from rotavg_ros.cli.data_folder import add_data_argument
from rotavg_ros.cli.options import evaluate_slam
from rotavg_ros.evaluation.names import RGBD_SETS, ROBUSTNESS_SETTINGS, SYNTHETIC_RECIPES


class _Suite(NamedTuple):
    """A table of the evaluation, and its options."""

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg evaluate``."""
    suites = parser.add_subparsers(dest="suite", metavar="SUITE", required=True)
    for suite in _SUITES:
        suite_parser = suites.add_parser(suite.name, help=suite.help, description=suite.help)
        suite_parser.add_argument(
            "--output",
            type=Path,
            default=Path("docs/results"),
            metavar="DIR",
            help="folder for the report (default: docs/results)",
        )
        suite_parser.add_argument(
            "--threads", type=thread_count, metavar="N", help="CPU threads (default: torch's choice)"
        )
        suite_parser.add_argument(
            "--keep",
            type=Path,
            metavar="DIR",
            help="keep answers (and the networks that robustness trains) here: a run that was interrupted goes on, and "
            "only what has changed is solved again",
        )
        suite.add_arguments(suite_parser)


def _add_synthetic(parser: argparse.ArgumentParser) -> None:
    _add_drawing(parser, 100)
    _add_methods(parser, "all rows of the table")
    parser.add_argument(
        "--recipes",
        nargs="+",
        choices=SYNTHETIC_RECIPES,
        default=["released", "paper"],
        metavar="NAME",
        help=f"generators of the graphs, of {', '.join(SYNTHETIC_RECIPES)} (default: released paper)",
    )
    parser.add_argument(
        "--few-graphs",
        type=whole_number,
        default=5,
        metavar="N",
        help="number of graphs for all rows but the main ones, unless --methods names them (default: 5)",
    )


def _add_robustness(parser: argparse.ArgumentParser) -> None:
    _add_drawing(parser, 20)
    parser.add_argument(
        "--settings",
        nargs="+",
        choices=ROBUSTNESS_SETTINGS,
        metavar="NAME",
        default=list(ROBUSTNESS_SETTINGS),
        help="rows of the table to run, in this order, the page rewritten after each; the others are said not to have "
        f"been (default: {' '.join(ROBUSTNESS_SETTINGS)})",
    )
    _add_minutes(parser, 60)


def _add_real(parser: argparse.ArgumentParser) -> None:
    add_data_argument(parser)
    _add_methods(parser, "all rows of the table")
    parser.add_argument(
        "--seed", type=whole_number, default=0, metavar="S", help="of the noise on real topologies (default: 0)"
    )


def _add_rgbd(parser: argparse.ArgumentParser) -> None:
    add_data_argument(parser)
    parser.add_argument(
        "--sets",
        nargs="+",
        choices=RGBD_SETS,
        default=list(RGBD_SETS),
        metavar="NAME",
        help=f"of {', '.join(RGBD_SETS)} (default: all)",
    )
    parser.add_argument(
        "--folds", type=positive_whole_number, default=4, metavar="K", help="of the cross-validation (default: 4)"
    )
    parser.add_argument("--scenes", type=positive_whole_number, metavar="N", help="of each set, at most (default: all)")
    _add_minutes(parser, 10)


def _add_minutes(parser: argparse.ArgumentParser, minutes: int) -> None:
    parser.add_argument(
        "--minutes",
        type=positive_number,
        default=float(minutes),
        metavar="M",
        help=f"training time of each pair of networks (default: {minutes})",
    )


def _add_drawing(parser: argparse.ArgumentParser, graphs: int) -> None:
    parser.add_argument("--graphs", type=positive_whole_number, default=graphs, metavar="N", help=f"default: {graphs}")
    parser.add_argument("--seed", type=whole_number, default=0, metavar="S", help="same seed, same graphs (default: 0)")


def _add_methods(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"methods of `rotavg solve`, combinations A+B, colmap, shonan, oracle (default: {default})",
    )


_SUITES = (
    _Suite("synthetic", "the paper's synthetic table, and how well outliers are told", _add_synthetic),
    _Suite(
        "robustness", "the paper's table of that name: trained on one kind of graph, tested on another", _add_robustness
    ),
    _Suite("real", "Lund with ground truth, Madrid without, real topologies", _add_real),
    _Suite("rgbd", "RGB-D scans, networks cross-validated over the scenes", _add_rgbd),
    _Suite("slam", "pose graphs with false closures, in one go and edge by edge", evaluate_slam.add_arguments),
)
