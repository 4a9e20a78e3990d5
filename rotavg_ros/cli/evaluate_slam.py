"""Options of ``rotavg evaluate slam``, and what runs it."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rotavg_ros.cli.arguments import share, whole_number
from rotavg_ros.cli.data_folder import add_data_argument, data_folder
from rotavg_ros.cli.progress import progress
from rotavg_ros.datasets.files.graph_file import read_graph
from rotavg_ros.evaluation.common.cases import drawings
from rotavg_ros.evaluation.common.contenders import contenders, warm_up
from rotavg_ros.evaluation.common.named_peers import is_available
from rotavg_ros.evaluation.common.scoring import Step, score_all
from rotavg_ros.evaluation.live import incremental
from rotavg_ros.evaluation.slam import cases, report, uncertainty
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS, ROSTER, ROWS

_INCREMENTAL = ("B25b_0.000",)
_UNCERTAINTY_GRAPHS = ("CSAIL", "intel", "manhattan", "sphere2500")
_UNCERTAINTY_DRAWS = 20


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """What to solve, and by whom."""
    parser.add_argument(
        "--graphs",
        nargs="+",
        choices=cases.GRAPHS,
        default=cases.GRAPHS,
        metavar="NAME",
        help=f"of {', '.join(cases.GRAPHS)} (default: all)",
    )
    parser.add_argument("--seeds", nargs="+", type=whole_number, default=[0, 1, 2], metavar="S", help="default: 0 1 2")
    parser.add_argument(
        "--shares",
        nargs="+",
        type=share,
        default=cases.SHARES,
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
        help=f"methods of `rotavg solve`, {', '.join(ROSTER.peers)}, odometry, least-squares (default: all)",
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
        choices=cases.GRAPHS,
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
    chosen = contenders(names, ROSTER, keep=arguments.keep)
    # What the last table needs shows before the hours that the others take.
    more = [_uncertainty_file(name) for name in _UNCERTAINTY_GRAPHS] if arguments.uncertainty else []
    data = data_folder(arguments, ("slam", *more))
    warm_up(contenders(names, ROSTER).values(), ROSTER)

    def watch(steps: Iterable[Step]) -> Iterable[Step]:
        return progress(steps, description="solving", unit="solve")

    kinds = cases.kinds(data, arguments.graphs, arguments.shares, arguments.hard)
    scores = score_all(drawings(kinds, arguments.seeds), chosen, watch)
    runs: list[incremental.IncrementalRun] = []
    checks: list[uncertainty.UncertaintyCheck] = []
    if not scores.interrupted:
        kinds = cases.kinds(data, arguments.incremental, [0.3], hard=False)
        for case in drawings(kinds, arguments.seeds[:1]):
            runs.append(incremental.play(case, watch=_watch_ticks(str(case.key))))
        for name in progress(_UNCERTAINTY_GRAPHS if more else (), description="uncertainty", total=len(more)):
            graph_file = read_graph(data / _uncertainty_file(name))
            checks += uncertainty.check(name, graph_file, _UNCERTAINTY_DRAWS, arguments.seeds[0])
    return report.report(arguments.output, scores, runs, checks, arguments.command_line)


def _uncertainty_file(name: str) -> str:
    return f"slam/{name}.g2o"


def _methods(arguments: argparse.Namespace) -> list[str]:
    """Those asked for, or all that can run here; always with ours and the oracle, which ratios need."""
    names = arguments.methods or [name for name in ROWS if is_available(name)]
    if not arguments.peers:
        names = [name for name in names if name not in ROSTER.peers]
    return list(dict.fromkeys((OURS, *names, ORACLE)))


def _watch_ticks(description: str) -> Callable[[Iterable[int]], Iterable[int]]:
    return lambda ticks: progress(ticks, description=description, unit="tick")
