"""Options of ``rotavg evaluate slam``."""

from __future__ import annotations

import argparse

from rotavg_ros.cli.arguments import share, whole_number
from rotavg_ros.cli.data_folder import add_data_argument
from rotavg_ros.evaluation.names import SLAM_GRAPHS, SLAM_SHARES, SLAM_SUITES
from rotavg_ros.solver.methods import SWITCHES

_INCREMENTAL = ("B25b_0.000",)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to solve, and by whom."""
    parser.add_argument(
        "--suite",
        dest="slam_suite",
        choices=SLAM_SUITES,
        default=SLAM_SUITES[0],
        help="recorded: real and classic graphs, some made worse; stress: about a hundred kinds of simulated graphs, "
        "each hard in one known way, which need no data; poses: graphs of known poses, and closures that join wrong "
        "places, judged by positions (default: recorded)",
    )
    parser.add_argument(
        "--kinds",
        nargs="+",
        metavar="TEXT",
        help="stress, poses: those kinds whose names contain one of the texts (default: all)",
    )
    parser.add_argument(
        "--graphs",
        nargs="+",
        choices=SLAM_GRAPHS,
        default=SLAM_GRAPHS,
        metavar="NAME",
        help=f"recorded: of {', '.join(SLAM_GRAPHS)} (default: all)",
    )
    parser.add_argument(
        "--seeds",
        nargs="+",
        type=whole_number,
        metavar="S",
        help="of the drawings (default: recorded 100 101 102; stress 1000 to 1019, poses 1000 to 1002; the solver is "
        "tuned on 0 to 19)",
    )
    parser.add_argument(
        "--shares",
        nargs="+",
        type=share,
        default=SLAM_SHARES,
        metavar="P",
        help="recorded: shares of false closures, 0 to 1 (default: 0 0.1 0.3 0.5 0.8)",
    )
    parser.add_argument(
        "--hard",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="recorded: false closures in groups and slipping odometry, too",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help="methods of `rotavg solve`, gnc, isam2, isam2-cauchy, isam2-geman-mcclure, open3d, colmap, odometry, "
        "least-squares (default: all; recorded without isam2-cauchy, isam2-geman-mcclure and open3d); "
        "poses: neurora-rotations, gnc-stated, gnc-true, gnc-wrong, isam2-cauchy, pcm, odometry",
    )
    parser.add_argument(
        "--without",
        nargs="+",
        default=(),
        choices=SWITCHES,
        metavar="PART",
        help=f"also ours without each of these: {', '.join(SWITCHES)}",
    )
    parser.add_argument(
        "--translations",
        action="store_true",
        help="stress suite: tell the translations of all edges, too, to the methods that use them",
    )
    parser.add_argument(
        "--search-or-model",
        action="store_true",
        help="stress suite: also solve every case from its true labels and tell why answers are wrong",
    )
    parser.add_argument(
        "--sensitivity",
        action="store_true",
        help="stress suite: also solve every case with each prior of the posterior halved and doubled",
    )
    parser.add_argument(
        "--peers",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="run GTSAM's, Open3D's and COLMAP's methods, which take seconds per graph",
    )
    parser.add_argument(
        "--incremental",
        nargs="*",
        choices=SLAM_GRAPHS,
        default=_INCREMENTAL,
        metavar="NAME",
        help="recorded: graphs to be played edge by edge, 30 %% false closures where made "
        f"(default: {' '.join(_INCREMENTAL)}, whatever --graphs says; without a name none)",
    )
    parser.add_argument(
        "--uncertainty",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="recorded: compare the stated uncertainty with errors under known noise, on graphs of its own",
    )
    add_data_argument(parser)
