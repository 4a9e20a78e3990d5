"""Options of ``rotavg evaluate slam``."""

from __future__ import annotations

import argparse

from rotavg_ros.cli.arguments import share, whole_number
from rotavg_ros.cli.data_folder import add_data_argument
from rotavg_ros.evaluation.names import SLAM_GRAPHS, SLAM_SHARES

_INCREMENTAL = ("B25b_0.000",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to solve, and by whom."""
    parser.add_argument(
        "--graphs",
        nargs="+",
        choices=SLAM_GRAPHS,
        default=SLAM_GRAPHS,
        metavar="NAME",
        help=f"of {', '.join(SLAM_GRAPHS)} (default: all)",
    )
    parser.add_argument("--seeds", nargs="+", type=whole_number, default=[0, 1, 2], metavar="S", help="default: 0 1 2")
    parser.add_argument(
        "--shares",
        nargs="+",
        type=share,
        default=SLAM_SHARES,
        metavar="P",
        help="shares of false closures, 0 to 1 (default: 0 0.1 0.3 0.5 0.8)",
    )
    parser.add_argument(
        "--hard",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="false closures in groups and slipping odometry, too",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help="methods of `rotavg solve`, gnc, isam2, colmap, odometry, least-squares (default: all)",
    )
    parser.add_argument(
        "--peers",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="run GTSAM's and COLMAP's methods, which take seconds per graph",
    )
    parser.add_argument(
        "--incremental",
        nargs="*",
        choices=SLAM_GRAPHS,
        default=_INCREMENTAL,
        metavar="NAME",
        help=f"graphs to be played edge by edge, 30 %% false closures where made (default: {' '.join(_INCREMENTAL)})",
    )
    parser.add_argument(
        "--uncertainty",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="compare the stated uncertainty with errors under known noise",
    )
    add_data_argument(parser)
