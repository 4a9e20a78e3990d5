"""Draw pictures (PNG) of a view-graph, or of training.

statistics: histograms of the angles and axes of the edges' noise against the truth; where the truth is unknown, of
their residuals against the solution.
training: what validation said after every epoch, a panel for each log.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import positive_number


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg plot``."""
    kinds = parser.add_subparsers(dest="kind", metavar="KIND", required=True)
    about = "histograms of the noise's angles and axes"
    statistics = kinds.add_parser("statistics", help=about, description=about)
    statistics.add_argument("graph", type=Path, metavar="GRAPH", help="view-graph file")
    statistics.add_argument("--truth", type=Path, metavar="FILE", help="ground truth, for graphs without their own")
    statistics.add_argument("--output", type=Path, metavar="PNG", help="default: <graph>-statistics.png, here")
    statistics.add_argument(
        "--outlier-angle",
        type=positive_number,
        metavar="DEG",
        help="noise of an outlier (default: 20, or 10 if the graph has odometry)",
    )
    about = "validation after every epoch of training"
    training = kinds.add_parser("training", help=about, description=about)
    training.add_argument("logs", type=Path, nargs="+", metavar="LOG", help="NAME.log.jsonl of `rotavg train`")
    training.add_argument(
        "--output", type=Path, metavar="PNG", default=Path("training.png"), help="default: training.png"
    )
