"""Replay a recorded bag through the node's estimator, without ROS, and write what it would have said.

Topics are found by their types and names; --list shows what each would be used as. DIR gets run.mcap (opens in
Foxglove), orientations.csv, edges.csv, trajectories (TUM, KITTI), graph.g2o, summary.json, report.html and pictures.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import non_negative_number, positive_number, whole_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg replay``."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder, .mcap, .db3, or a ROS 1 .bag")
    parser.add_argument("--output", type=Path, metavar="DIR", help="folder for the answer")
    parser.add_argument("--overwrite", action="store_true", help="replace an older replay's files in DIR")
    parser.add_argument("--list", action="store_true", help="only list the topics and what each would be used as")
    topics = parser.add_argument_group("topics", "each may be given several times; 'none' uses none")
    topics.add_argument("--odometry", action="append", metavar="TOPIC[:TYPE]", help="one per robot")
    topics.add_argument("--robots", nargs="+", metavar="NAME", help="names, one per --odometry")
    topics.add_argument("--edges", action="append", metavar="TOPIC[:TYPE]", help="relative rotations")
    topics.add_argument(
        "--reference", action="append", metavar="TOPIC|FILE", help="to compare with: a topic, or TUM, KITTI, EuRoC csv"
    )
    window = parser.add_argument_group("window")
    window.add_argument("--start", type=non_negative_number, default=0.0, metavar="S", help="seconds into the bag")
    window.add_argument("--duration", type=positive_number, metavar="S", help="seconds to replay")
    window.add_argument(
        "--rate", type=non_negative_number, default=0.0, metavar="R", help="times real time; 0: as fast as possible"
    )
    node = parser.add_argument_group("the node's parameters")
    node.add_argument("--params", type=Path, metavar="YAML", help="a file as for the node's --params-file")
    node.add_argument("-p", action="append", default=[], metavar="NAME:=VALUE", help="one parameter")
    parser.add_argument(
        "--answers",
        type=whole_number,
        default=200,
        metavar="N",
        help="about this many answers go into run.mcap, evenly spread over time; 0: all (default: 200)",
    )
    parser.add_argument("--no-report", action="store_true", help="leave out report.html and its pictures")
