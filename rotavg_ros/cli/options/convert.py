"""Convert a view-graph between formats, chosen by suffix.

  .g2o                g2o pose graph (the tags of TORO and iSAM are read as well)
  .toro .graph        TORO pose graph
  .isam               iSAM pose graph, in the plane
  .txt                1DSfM EGs.txt
  .npz                arrays, see docs/formats.md
  .mat                Lund's MATLAB files, read only
  a folder            rosbag2 (MCAP): edges, chained odometry, ground truth; also read: .mcap, .db3, .bag

Says what the output format has no room for.
"""

from __future__ import annotations

import argparse
from pathlib import Path


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg convert``."""
    parser.add_argument("input", type=Path, metavar="INPUT", help="view-graph file or bag")
    parser.add_argument("output", type=Path, metavar="OUTPUT", help="where to; its suffix says which format")
    parser.add_argument("--overwrite", action="store_true", help="replace an existing OUTPUT")
    parser.add_argument(
        "--stamps", type=Path, metavar="TXT", help="text file with one stamp in seconds per node, ascending by id"
    )
    parser.add_argument(
        "--truth",
        type=Path,
        metavar="CSV",
        help="ground truth: id,qx,qy,qz,qw (world_from_body), or headerless stamp, x, y, heading within 0.15 s",
    )
