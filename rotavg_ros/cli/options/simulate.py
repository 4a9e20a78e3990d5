"""Simulate a robot on several laps of a building or of city streets and write the bag it would have recorded.

The bag (rosbag2, MCAP) has, at 10 Hz, /odom (drifting) and /ground_truth, and loop closures by stamp on
/relative_rotations, a chosen share of them false. Play it with `rotavg play`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import finite_number, non_negative_number, positive_number, share, whole_number
from rotavg_ros.datasets.worlds import ROBOT_WORLDS


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg simulate``."""
    parser.add_argument("--output", type=Path, required=True, metavar="BAG", help="folder of the bag to write")
    parser.add_argument("--overwrite", action="store_true", help="replace an older bag and graph")
    parser.add_argument("--graph", type=Path, metavar="FILE", help="also write the pose graph (.g2o, .npz)")
    add_run_arguments(parser)


def add_run_arguments(parser: argparse.ArgumentParser) -> None:
    """What the run is like; shared with ``rotavg demo``."""
    parser.add_argument("--world", choices=ROBOT_WORLDS, default="building", help="default: building")
    parser.add_argument(
        "--dimensions", type=int, choices=(2, 3), default=2, help="3: ramps and uneven ground (default: 2)"
    )
    parser.add_argument(
        "--laps", type=positive_number, default=4, metavar="N", help="visits of every place, about (default: 4)"
    )
    parser.add_argument(
        "--false-share", type=share, default=0.3, metavar="SHARE", help="of the closures (default: 0.3)"
    )
    parser.add_argument("--grouped", action="store_true", help="false closures in groups that agree with each other")
    parser.add_argument(
        "--closures-per-minute", type=non_negative_number, default=20, metavar="N", help="good and false (default: 20)"
    )
    parser.add_argument(
        "--closure-noise-deg", type=non_negative_number, default=1.0, metavar="DEG", help="RMS angle (default: 1)"
    )
    parser.add_argument(
        "--odometry-noise-deg",
        type=non_negative_number,
        default=0.1,
        metavar="DEG",
        help="RMS angle every 0.1 s (default: 0.1)",
    )
    parser.add_argument(
        "--odometry-bias-deg-per-min",
        type=finite_number,
        default=2.0,
        metavar="DEG",
        help="gyroscope bias (default: 2)",
    )
    parser.add_argument("--seed", type=whole_number, default=0, metavar="S", help="same seed, same run (default: 0)")
