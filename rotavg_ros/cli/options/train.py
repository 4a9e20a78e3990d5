"""Train a network of NeuRoRA on simulated view-graphs.

CONFIG is a YAML file, or the name of one that comes with the package: sfm-clean-net, sfm-fine-net, slam-clean-net, and
the later stages that the package's own networks went through: sfm-clean-net-broad and sfm-fine-net-settled, then
sfm-clean-net-canonical and sfm-fine-net-canonical. The method neurora-paper has paper-clean-net, then
paper-clean-net-settled, and paper-fine-net.
DIR gets, for the network NAME, the best weights (NAME.safetensors), their model card (NAME.json), a log with a line per
epoch (NAME.log.jsonl) and a checkpoint. Run the same command again after an interruption: training goes on as if it had
never stopped. A FineNet learns on what a CleanNet leaves, so train CleanNet first, into the same DIR.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import thread_count
from rotavg_ros.solver.methods import DEVICES


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg train``."""
    parser.add_argument("network", choices=("clean-net", "fine-net"), help="of SLAM graphs, a CleanNet alone")
    parser.add_argument("config", metavar="CONFIG", help="YAML file, or the name of one of the package's")
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for weights and checkpoint")
    parser.add_argument(
        "--clean-net",
        type=Path,
        metavar="WEIGHTS",
        help="fine-net: the CleanNet before it (default: the one in DIR if there is one, else the package's)",
    )
    parser.add_argument(
        "--start", type=Path, metavar="WEIGHTS", help="weights of the same network to go on from (default: drawn)"
    )
    parser.add_argument("--device", default="auto", choices=DEVICES, help="default: auto")
    parser.add_argument("--threads", type=thread_count, metavar="N", help="CPU threads (default: torch's choice)")
