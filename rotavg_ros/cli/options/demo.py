"""Watch the node correct a robot's orientations.

Simulates a run (or takes your own graph), plays it to the installed node over ROS 2, and shows what came out in a table
and a picture. Everything goes into a new folder: the bag, the node's log, summary.json and demo.png. Nothing leaves
this machine.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import non_negative_number
from rotavg_ros.cli.options.simulate import add_run_arguments


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg demo``."""
    parser.add_argument(
        "--graph", type=Path, metavar="FILE", help="your own graph, as for `rotavg solve`, instead of a simulation"
    )
    parser.add_argument("--truth", type=Path, metavar="CSV", help="ground truth of --graph, as for `rotavg convert`")
    parser.add_argument("--stamps", type=Path, metavar="TXT", help="stamps of --graph, as for `rotavg convert`")
    parser.add_argument(
        "--output", type=Path, metavar="DIR", help="new folder (default: rotavg_demo, rotavg_demo_2, …)"
    )
    parser.add_argument(
        "--rate",
        type=non_negative_number,
        metavar="R",
        help="times real time; 0: as fast as possible (default: in about 12 s)",
    )
    add_run_arguments(parser)
