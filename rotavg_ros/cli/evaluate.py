"""Compare the methods; write tables (Markdown, CSV) and pictures (PNG) of what comes out."""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from rotavg_ros.cli.progress import progress
from rotavg_ros.evaluation import synthetic
from rotavg_ros.evaluation.contenders import Case, Contender, contenders, is_available, warm_up
from rotavg_ros.evaluation.scoring import Scores, Step, score_all
from rotavg_ros.evaluation.tables import make_folder


class _Suite(NamedTuple):
    """A table of the evaluation: its options, and what runs it and returns the report."""

    name: str
    help: str
    add_arguments: Callable[[argparse.ArgumentParser], None]
    run: Callable[[argparse.Namespace], Path]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """The options of ``rotavg evaluate``."""
    suites = parser.add_subparsers(dest="suite", metavar="SUITE", required=True)
    for suite in _SUITES:
        suite_parser = suites.add_parser(suite.name, help=suite.help, description=suite.help)
        suite_parser.add_argument(
            "--output", type=Path, default=Path("docs/results"), metavar="DIR", help="default: docs/results"
        )
        suite_parser.add_argument("--threads", type=_count, metavar="N", help="CPU threads (default: torch's choice)")
        suite.add_arguments(suite_parser)


def run(arguments: argparse.Namespace) -> int:
    """Run one suite."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    make_folder(arguments.output)
    suite = next(suite for suite in _SUITES if suite.name == arguments.suite)
    print(suite.run(arguments))
    return 0


def _add_synthetic(parser: argparse.ArgumentParser) -> None:
    _add_drawing(parser, 100)
    _add_methods(parser, "all rows of the table")
    parser.add_argument(
        "--recipes",
        nargs="+",
        choices=tuple(synthetic.RECIPES),
        default=["released", "paper"],
        help="generators of the graphs (default: released paper)",
    )


def _run_synthetic(arguments: argparse.Namespace) -> Path:
    chosen = _contenders(arguments.methods, synthetic.ROWS)
    scores = {
        recipe: _score(synthetic.cases(recipe, arguments.graphs, arguments.seed), chosen, arguments.graphs, recipe)
        for recipe in arguments.recipes
    }
    return synthetic.report(arguments.output, scores, tuple(chosen), arguments.graphs, arguments.seed)


def _add_drawing(parser: argparse.ArgumentParser, graphs: int) -> None:
    parser.add_argument("--graphs", type=_count, default=graphs, metavar="N", help=f"default: {graphs}")
    parser.add_argument("--seed", type=_seed, default=0, metavar="S", help="same seed, same graphs (default: 0)")


def _add_methods(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"methods of `rotavg solve`, combinations A+B, colmap, shonan, oracle (default: {default})",
    )


def _contenders(names: Sequence[str] | None, default: Iterable[str]) -> dict[str, Contender]:
    """Those asked for, or what can run here of the default."""
    chosen = contenders(names if names is not None else [name for name in default if is_available(name)])
    warm_up(tuple(chosen.values()))
    return chosen


def _score(cases: Iterable[Case], chosen: dict[str, Contender], count: int, description: str) -> Scores:
    def watch(steps: Iterable[Step]) -> Iterable[Step]:
        return progress(steps, total=count * len(chosen), description=description, unit="solve")

    return score_all(cases, chosen, watch)


def _count(text: str) -> int:
    number = int(text)
    if number < 1:
        raise argparse.ArgumentTypeError("must be 1 or more")
    return number


def _seed(text: str) -> int:
    seed = int(text)
    if seed < 0:
        raise argparse.ArgumentTypeError("must be 0 or more")
    return seed


_SUITES = (
    _Suite("synthetic", "the paper's synthetic table, and how well outliers are told", _add_synthetic, _run_synthetic),
)
