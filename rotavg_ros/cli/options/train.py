"""Train a network of NeuRoRA on simulated view-graphs.

CONFIG is a YAML file, or the name of one that comes with the package: sfm-clean-net, sfm-fine-net, slam-clean-net,
slam-fine-net, and the later stages that the package's own networks went through: sfm-clean-net-broad and
sfm-fine-net-settled, then sfm-clean-net-canonical and sfm-fine-net-canonical. Those of slam are of robots' graphs. The
method neurora-paper has paper-clean-net, then paper-clean-net-settled, and paper-fine-net.
DIR gets, for the network NAME, the best weights (NAME.safetensors), their model card (NAME.json), a log with a line per
epoch (NAME.log.jsonl) and a checkpoint. Run the same command again after an interruption: training goes on as if it had
never stopped. An SfM FineNet learns on what a CleanNet leaves, so train CleanNet first, into the same DIR.

`rotavg train slam --from GRAPH…` looks at how your robot errs in its own runs, simulates runs that err alike, and goes
on training FineNet of robots' graphs on these. DIR gets the outcome only if it explains stretches of your runs that
were held back better than before, by more than chance does (2.3 %). Once interrupted, it begins anew in another DIR.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import positive_number, thread_count
from rotavg_ros.solver.methods import DEVICES

NETWORKS = ("clean-net", "fine-net", "slam-clean-net", "slam-fine-net", "slam")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg train``."""
    parser.add_argument(
        "network",
        choices=NETWORKS,
        help="clean-net and fine-net: of the configuration's family; slam: fine-tune on your robot's own runs (--from)",
    )
    parser.add_argument(
        "config",
        nargs="?",
        metavar="CONFIG",
        help="YAML file, or the name of one of the package's (default: the one of the network's name; clean-net and "
        "fine-net have none)",
    )
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
    parser.add_argument(
        "--from",
        dest="runs",
        nargs="+",
        type=Path,
        metavar="GRAPH",
        help="slam: graphs of your robot's runs, as files or as bags of `rotavg convert` and of the node's topics",
    )
    parser.add_argument(
        "--truth", nargs="+", type=Path, metavar="FILE", help="slam: ground truth of each of these, in their order"
    )
    parser.add_argument(
        "--minutes", type=positive_number, default=10.0, metavar="MIN", help="slam: to simulate and train (default: 10)"
    )
    parser.add_argument("--threads", type=thread_count, metavar="N", help="CPU threads (default: torch's choice)")
