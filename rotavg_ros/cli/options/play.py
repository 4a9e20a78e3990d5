"""Publish a bag's messages live over ROS 2, as they were recorded, stamps unchanged.

Waits for a subscriber first, and until every reliable subscriber has everything before it ends.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import non_negative_number, positive_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg play``."""
    parser.add_argument("bag", type=Path, metavar="BAG", help="rosbag2 folder, or a single .mcap or .db3")
    parser.add_argument(
        "--rate",
        type=non_negative_number,
        default=1.0,
        metavar="R",
        help="times real time; 0: as fast as possible (default: 1)",
    )
    parser.add_argument("--topics", nargs="+", metavar="TOPIC", help="only these (default: all)")
    parser.add_argument(
        "--wait-for-subscribers",
        type=non_negative_number,
        default=10.0,
        metavar="SECONDS",
        help="give up if nobody listens by then; 0: do not wait (default: 10)",
    )
    parser.add_argument("--clock", action="store_true", help="publish the bag's time on /clock")
    parser.add_argument(
        "--max-messages-per-second",
        type=positive_number,
        default=3000.0,
        metavar="N",
        help="bound of bursts (default: 3000)",
    )
