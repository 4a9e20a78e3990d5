"""Options of ``rotavg evaluate slam``, and what runs it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rotavg_ros.cli.arguments import share, whole_number
from rotavg_ros.cli.data_folder import add_data_argument, data_folder
from rotavg_ros.cli.progress import progress
from rotavg_ros.datasets.files.graph_file import read_graph
from rotavg_ros.evaluation import slam_cases, slam_contenders, slam_incremental, slam_report, slam_uncertainty
from rotavg_ros.evaluation.named_peers import is_available
from rotavg_ros.evaluation.slam_scoring import REFERENCE, Step, score_all

_INCREMENTAL = ("B25b_0.000",)
_UNCERTAINTY_GRAPHS = ("CSAIL", "intel", "manhattan", "sphere2500")
_UNCERTAINTY_DRAWS = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to solve, and by whom."""
    parser.add_argument(
        "--graphs",
        nargs="+",
        choices=slam_cases.GRAPHS,
        default=slam_cases.GRAPHS,
        metavar="NAME",
        help=f"of {', '.join(slam_cases.GRAPHS)} (default: all)",
    )
    parser.add_argument("--seeds", nargs="+", type=whole_number, default=[0, 1, 2], metavar="S", help="default: 0 1 2")
    parser.add_argument(
        "--shares",
        nargs="+",
        type=share,
        default=slam_cases.SHARES,
        metavar="P",
        help="shares of false closures, 0 to 1 (default: 0 0.1 0.3 0.5 0.8)",
    )
    parser.add_argument(
        "--hard",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="false closures in groups and slipping odometry, too",
    )
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"methods of `rotavg solve`, {', '.join(slam_contenders.PEERS)}, odometry, least-squares (default: all)",
    )
    parser.add_argument(
        "--peers",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="run GTSAM's and COLMAP's methods, which take seconds per graph",
    )
    parser.add_argument(
        "--incremental",
        nargs="*",
        choices=slam_cases.GRAPHS,
        default=_INCREMENTAL,
        metavar="NAME",
        help=f"graphs to be played edge by edge, 30 %% false closures where made (default: {' '.join(_INCREMENTAL)})",
    )
    parser.add_argument(
        "--uncertainty",
        action=argparse.BooleanOptionalAction,
        default=True,
        help="compare the stated uncertainty with errors under known noise",
    )
    add_data_argument(parser)


def run(arguments: argparse.Namespace) -> Path:
    """Run the suite and write the report; returns the Markdown file."""
    names = _methods(arguments)
    chosen = slam_contenders.contenders(names, arguments.keep)
    # What the last table needs shows before the hours that the others take.
    more = [_uncertainty_file(name) for name in _UNCERTAINTY_GRAPHS] if arguments.uncertainty else []
    data = data_folder(arguments, ("slam", *more))
    slam_contenders.warm_up(tuple(slam_contenders.contenders(names).values()))

    def watch(steps: Iterable[Step]) -> Iterable[Step]:
        return progress(steps, description="solving", unit="solve")

    cases = slam_cases.cases(data, arguments.graphs, arguments.shares, arguments.seeds, arguments.hard)
    scores = score_all(cases, chosen, watch)
    played = slam_cases.cases(data, arguments.incremental, [0.3], arguments.seeds[:1], hard=False)
    runs = [slam_incremental.play(case, watch=_watch_ticks(case.name)) for case in played]
    checks: list[slam_uncertainty.UncertaintyCheck] = []
    if arguments.uncertainty:
        for name in progress(_UNCERTAINTY_GRAPHS, description="uncertainty", total=len(_UNCERTAINTY_GRAPHS)):
            graph_file = read_graph(data / _uncertainty_file(name))
            checks += slam_uncertainty.check(name, graph_file, _UNCERTAINTY_DRAWS, arguments.seeds[0])
    return slam_report.report(arguments.output, scores, runs, checks, arguments.command_line)


def _uncertainty_file(name: str) -> str:
    return f"slam/{name}.g2o"


def _methods(arguments: argparse.Namespace) -> list[str]:
    """Those asked for, or all that can run here; always with ours and the oracle, which ratios need."""
    names = arguments.methods or [name for name in slam_contenders.ROWS if is_available(name)]
    if not arguments.peers:
        names = [name for name in names if name not in slam_contenders.PEERS]
    return list(dict.fromkeys((slam_contenders.OURS, *names, REFERENCE)))


def _watch_ticks(description: str) -> Callable[[Iterable[int]], Iterable[int]]:
    return lambda ticks: progress(ticks, description=description, unit="tick")
