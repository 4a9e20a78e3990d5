"""Solve view-graph files: absolute orientations and an outlier score for every edge.

Reads g2o, TORO, iSAM, 1DSfM EGs.txt (gzipped, too), npz and Lund's .mat.
Writes to DIR, or to DIR/<stem> for several graphs:
  orientations.csv  id,qx,qy,qz,qw,component,sigma_deg   world_from_body, ascending by id
  edges.csv         source,target,outlier_score,outlier   in the order of the file (or edges.npz)
  summary.json      counts, warnings, seconds, memory, device, method, version
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import whole_number
from rotavg_ros.solver.methods import DEFAULT_METHOD, DEVICES, METHODS, PROFILES, SWITCHES, TRANSLATION_SCALES

EDGE_FORMATS = ("csv", "npz")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg solve``."""
    parser.add_argument("graphs", nargs="+", type=Path, metavar="GRAPH", help="view-graph file")
    parser.add_argument("--output", required=True, type=Path, metavar="DIR", help="folder for the answer")
    switches = f"terms, moves or networks to switch off, of {', '.join(SWITCHES)}"
    methods = f"{', '.join(METHODS)}, or A+B: B starts from A's answer (default: neurora)"
    parser.add_argument("--method", default="neurora", metavar="NAME", help=methods)
    parser.add_argument(
        "--without",
        nargs="+",
        default=(),
        choices=SWITCHES,
        metavar="PART",
        help=f"with --method {DEFAULT_METHOD} on robots' graphs: {switches}",
    )
    parser.add_argument(
        "--profile", default="auto", choices=PROFILES, help="auto (default): slam if any edge is odometry"
    )
    parser.add_argument(
        "--translation-scale",
        default=TRANSLATION_SCALES[0],
        choices=TRANSLATION_SCALES,
        help="metric (default): translations are in metres, and closures of wrong places are told by them; none: they "
        "are not, and tell positions alone",
    )
    parser.add_argument(
        "--device",
        default="auto",
        choices=DEVICES,
        help="of photo collections and scans; a robot's graph is solved on the CPU (default: auto)",
    )
    parser.add_argument(
        "--refine",
        type=whole_number,
        metavar="N",
        help="at most N refinement steps; 0 skips (default: the method's); of a robot's graph, 0 or all",
    )
    parser.add_argument(
        "--weights", type=Path, metavar="DIR", help="networks of `rotavg train`; what DIR lacks comes from the package"
    )
    parser.add_argument(
        "--poses",
        action="store_true",
        help="also write the corrected graph.g2o and trajectory.kitti (.tum with stamps)",
    )
    parser.add_argument(
        "--edges", default="csv", choices=(*EDGE_FORMATS, "none"), help="format of the edges' file (default: csv)"
    )
