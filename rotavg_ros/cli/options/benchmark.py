"""Time the solver beside COLMAP and GTSAM on the same graphs; write tables (Markdown, CSV) and scaling pictures.

Every contender runs in a process of its own, after a tiny graph that pays what a process pays once. Errors count
against the truth. Contenders that would take too long of the given minutes are left out, and the report says so. One
size by itself: --families sfm-dense --min-pairs 7000000 --max-pairs 9000000 --contenders neurora.
With --soak, a live node holds a graph of 10 000 keyframes while odometry arrives over DDS; with --soak --hours, the
estimator drives for so long in this process, as fast as it goes. With --small, such nodes hold graphs of several sizes
on one core and on two, for who chooses a machine: memory and CPU.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from rotavg_ros.cli.arguments import positive_number, positive_whole_number, thread_count, whole_number
from rotavg_ros.evaluation.names import BENCHMARK_CONTENDERS, BENCHMARK_FAMILIES

SOAK_KEYFRAMES, SOAK_SECONDS = 10_000, 60.0
SMALL_KEYFRAMES = (1000, 10_000)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg benchmark``."""
    parser.add_argument(
        "--output",
        type=Path,
        default=Path("docs/results"),
        metavar="DIR",
        help="folder for the report (default: docs/results)",
    )
    parser.add_argument(
        "--families",
        nargs="+",
        choices=BENCHMARK_FAMILIES,
        default=list(BENCHMARK_FAMILIES),
        metavar="NAME",
        help=f"of {', '.join(BENCHMARK_FAMILIES)} (default: all)",
    )
    parser.add_argument(
        "--minutes", type=positive_number, default=20.0, metavar="M", help="about how long in all (default: 20)"
    )
    parser.add_argument(
        "--min-pairs", type=positive_whole_number, default=1, metavar="N", help="edges at least (default: 1)"
    )
    parser.add_argument(
        "--max-pairs", type=positive_whole_number, default=8_000_000, metavar="N", help="edges at most (default: 8e6)"
    )
    parser.add_argument(
        "--contenders",
        nargs="+",
        choices=BENCHMARK_CONTENDERS,
        default=list(BENCHMARK_CONTENDERS),
        metavar="NAME",
        help=f"of {', '.join(BENCHMARK_CONTENDERS)} (default: all)",
    )
    parser.add_argument(
        "--repeats", type=positive_whole_number, default=5, metavar="N", help="solves by each, at most (default: 5)"
    )
    parser.add_argument("--threads", type=thread_count, metavar="N", help="CPU threads (default: torch's)")
    parser.add_argument("--soak", action="store_true", help="the node under load instead of the solvers")
    parser.add_argument("--small", action="store_true", help="the node on one core and on two instead")
    parser.add_argument(
        "--ticks",
        type=positive_whole_number,
        metavar="N",
        help="this many ticks of the estimator beside iSAM2's instead, on a graph that grows",
    )
    parser.add_argument(
        "--busy",
        type=whole_number,
        metavar="N",
        help="with --ticks: number of busy loops beside them, each on a core (default: 0)",
    )
    parser.add_argument(
        "--seconds", type=positive_number, metavar="S", help=f"of each run of a node (default: {SOAK_SECONDS:g})"
    )
    parser.add_argument(
        "--keyframes",
        type=positive_whole_number,
        nargs="+",
        metavar="N",
        help=f"of a soak, and before --ticks (default: {SOAK_KEYFRAMES}), or several, of --small "
        f"(default: {' '.join(map(str, SMALL_KEYFRAMES))})",
    )
    parser.add_argument(
        "--hours",
        type=positive_number,
        metavar="H",
        help="of a soak: so long a drive through the estimator, without DDS, for memory",
    )
    parser.add_argument(
        "--max-keyframes", type=positive_whole_number, metavar="N", help="of such a drive (default: the node's)"
    )
