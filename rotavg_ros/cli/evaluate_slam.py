"""What ``rotavg evaluate slam`` does."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable
from pathlib import Path

from rotavg_ros.cli.data_folder import data_folder
from rotavg_ros.cli.progress import progress, working
from rotavg_ros.datasets.graph_file import read_graph
from rotavg_ros.evaluation import slam_cases, slam_contenders, slam_incremental, slam_report, slam_uncertainty
from rotavg_ros.evaluation.named_peers import is_available
from rotavg_ros.evaluation.slam_scoring import REFERENCE, Step, score_all

_UNCERTAINTY_GRAPHS = ("CSAIL", "intel", "manhattan", "sphere2500")
_UNCERTAINTY_DRAWS = 20


def run(arguments: argparse.Namespace) -> Path:
    """Run the suite and write the report; returns the Markdown file."""
    names = _methods(arguments)
    chosen = slam_contenders.contenders(names, arguments.keep)
    # What the last table needs shows before the hours that the others take.
    more = [_uncertainty_file(name) for name in _UNCERTAINTY_GRAPHS] if arguments.uncertainty else []
    data = data_folder(arguments, ("slam", *more))
    with working("warming up"):
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
