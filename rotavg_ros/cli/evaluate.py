"""Compare the methods; write tables (Markdown, CSV) and pictures (PNG) of what comes out."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import torch

from rotavg_ros.cli import evaluate_slam
from rotavg_ros.cli.arguments import positive_number, positive_whole_number, thread_count, whole_number
from rotavg_ros.cli.data_folder import add_data_argument, data_folder
from rotavg_ros.cli.progress import progress, working
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation import real, rgbd, robustness, synthetic
from rotavg_ros.evaluation.contenders import Case, Contender, contenders, warm_up
from rotavg_ros.evaluation.named_peers import is_available
from rotavg_ros.evaluation.scoring import Scores, Step, score_all
from rotavg_ros.evaluation.small_training import train_networks
from rotavg_ros.evaluation.tables import Table, make_folder, write_report


class EvaluateError(UserError):
    """Options that an evaluation cannot work with."""


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
            "--output",
            type=Path,
            default=Path("docs/results"),
            metavar="DIR",
            help="folder for the report (default: docs/results)",
        )
        suite_parser.add_argument(
            "--threads", type=thread_count, metavar="N", help="CPU threads (default: torch's choice)"
        )
        suite_parser.add_argument(
            "--keep",
            type=Path,
            metavar="DIR",
            help="keep answers here: a run that was interrupted goes on, and only what has changed is solved again",
        )
        suite.add_arguments(suite_parser)


def run(arguments: argparse.Namespace) -> int:
    """Run one suite."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    make_folder(arguments.output)
    if arguments.keep is not None:
        make_folder(arguments.keep)
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
        metavar="NAME",
        help=f"generators of the graphs, of {', '.join(synthetic.RECIPES)} (default: released paper)",
    )
    parser.add_argument(
        "--few-graphs",
        type=whole_number,
        default=5,
        metavar="N",
        help=f"so many graphs for other rows than {' '.join(synthetic.CORE)}, unless --methods names them (default: 5)",
    )


def _run_synthetic(arguments: argparse.Namespace) -> Path:
    core = _contenders(arguments.methods, synthetic.CORE, keep=arguments.keep)
    few = min(arguments.few_graphs, arguments.graphs)
    is_all = arguments.methods is not None or few == 0
    others = [name for name in synthetic.ROWS if name not in synthetic.CORE]
    more = {} if is_all else _contenders(None, others, keep=arguments.keep)
    scores, scores_of_few = {}, {}
    for recipe in arguments.recipes:
        cases = synthetic.cases(recipe, arguments.graphs, arguments.seed)
        scores[recipe] = _score(cases, core, arguments.graphs, recipe)
        if more:
            cases = synthetic.cases(recipe, few, arguments.seed)
            scores_of_few[recipe] = _score(cases, more, few, f"{recipe}, more methods")
    return synthetic.report(arguments.output, scores, tuple(core), scores_of_few, tuple(more), arguments.command_line)


def _add_robustness(parser: argparse.ArgumentParser) -> None:
    _add_drawing(parser, 10)
    _add_methods(parser, " ".join(_ROBUSTNESS_METHODS))
    parser.add_argument(
        "--settings",
        nargs="+",
        choices=tuple(robustness.SETTINGS),
        metavar="NAME",
        default=list(robustness.SETTINGS),
        help=f"rows of the table (default: {' '.join(robustness.SETTINGS)})",
    )
    _add_minutes(parser)


def _run_robustness(arguments: argparse.Namespace) -> Path:
    names = tuple(arguments.methods or _ROBUSTNESS_METHODS)
    contenders(names)  # mistakes show before any training
    scores = {}
    with tempfile.TemporaryDirectory() as folder:
        trained = {robustness.SETTINGS[setting].training for setting in arguments.settings} - {robustness.PACKAGE}
        for training in sorted(trained):
            graphs = robustness.training_graphs(training, arguments.seed)
            train_networks(Path(folder) / training, graphs, 60 * arguments.minutes)
        for setting in arguments.settings:
            training = robustness.SETTINGS[setting].training
            weights = None if training == robustness.PACKAGE else Path(folder) / training
            fit = [name for name in names if robustness.is_fit(setting, name)]
            chosen = _contenders(fit, (), weights, arguments.keep)
            count = robustness.num_graphs(setting, arguments.graphs)
            scores[setting] = _score(robustness.cases(setting, count, arguments.seed), chosen, count, setting)
    return robustness.report(arguments.output, scores, names, arguments.command_line)


def _add_real(parser: argparse.ArgumentParser) -> None:
    add_data_argument(parser)
    _add_methods(parser, " ".join(real.METHODS))
    parser.add_argument(
        "--seed", type=whole_number, default=0, metavar="S", help="of the noise on real topologies (default: 0)"
    )


def _run_real(arguments: argparse.Namespace) -> Path:
    data = data_folder(arguments, (real.LUND, real.MADRID, real.TOPOLOGIES))
    chosen = _contenders(arguments.methods, real.METHODS, keep=arguments.keep)
    lund, madrid = real.lund_case(data), real.madrid_case(data)
    on_lund = _score([lund], chosen, 1, lund.name)
    fast = {name: contender for name, contender in chosen.items() if name not in real.SLOW_ON_TOPOLOGIES}
    on_topologies = {}
    for noise, recipe in real.NOISE.items():
        topologies = list(real.topology_cases(data, arguments.seed, recipe))
        on_topologies[noise] = _score(topologies, fast, len(topologies), f"real topologies, {noise}")
    with working(madrid.name):
        found = real.agreement(madrid, chosen)
    names = tuple(chosen)
    tables: dict[str, Table] = {
        "real-lund": real.errors_table(lund.name, on_lund, names, "70 cameras, 1207 edges; ground truth."),
    }
    graphs = {}
    for number, (noise, scores) in enumerate(on_topologies.items(), 1):
        title = f"1DSfM topologies, noise of {noise}"
        note = f"{len({row.case for row in scores.rows})} real topologies; without what takes minutes a graph."
        tables[f"real-topologies-{number}"] = real.errors_table(title, scores, names, note)
        graphs[f"real-topologies-{number}-graphs"] = synthetic.per_graph(title, scores)
    tables["real-madrid-residuals"] = real.residual_table(madrid.name, found)
    tables["real-madrid-agreement"] = real.agreement_table(f"{madrid.name}: who agrees with whom", found)
    introduction = f"`{arguments.command_line}`"
    return write_report(arguments.output, "real", "Real view-graphs", introduction, tables, {}, graphs)


def _add_rgbd(parser: argparse.ArgumentParser) -> None:
    add_data_argument(parser)
    parser.add_argument(
        "--sets",
        nargs="+",
        choices=rgbd.SETS,
        default=list(rgbd.SETS),
        metavar="NAME",
        help=f"of {', '.join(rgbd.SETS)} (default: all)",
    )
    parser.add_argument(
        "--folds", type=positive_whole_number, default=4, metavar="K", help="of the cross-validation (default: 4)"
    )
    parser.add_argument("--scenes", type=positive_whole_number, metavar="N", help="of each set, at most (default: all)")
    _add_minutes(parser)


def _run_rgbd(arguments: argparse.Namespace) -> Path:
    data = data_folder(arguments, [f"rgbd/{name}" for name in arguments.sets])
    if arguments.folds < 2:
        raise EvaluateError("--folds must be 2 or more: what is tested must not be trained on")
    split = {name: list(rgbd.folds(data / "rgbd" / name, arguments.folds, arguments.scenes)) for name in arguments.sets}
    tables = {}
    for name, folds in split.items():
        scores = Scores()
        for fold in progress(folds, description=name, unit="fold"):
            with tempfile.TemporaryDirectory() as folder:
                train_networks(Path(folder), fold.training, 60 * arguments.minutes, from_package=True)
                trained = contenders(rgbd.TRAINED, Path(folder))
                own = contenders(rgbd.TRAINED, keep=arguments.keep)
                own = {rgbd.PACKAGE_PREFIX + method: contender for method, contender in own.items()}
                untrained = contenders(rgbd.UNTRAINED, keep=arguments.keep)
                scores.extend(score_all(fold.test, {**untrained, **own, **trained}))
        tables[f"rgbd-{name}"] = rgbd.table(name, scores, arguments.minutes)
    introduction = (
        f"`{arguments.command_line}`: scans registered pairwise, most of the registrations wrong; degrees per scene, "
        "averaged."
    )
    return write_report(arguments.output, "rgbd", "RGB-D scans", introduction, tables, {})


def _add_minutes(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--minutes",
        type=positive_number,
        default=10.0,
        metavar="M",
        help="training time of each pair of networks (default: 10)",
    )


def _add_drawing(parser: argparse.ArgumentParser, graphs: int) -> None:
    parser.add_argument("--graphs", type=positive_whole_number, default=graphs, metavar="N", help=f"default: {graphs}")
    parser.add_argument("--seed", type=whole_number, default=0, metavar="S", help="same seed, same graphs (default: 0)")


def _add_methods(parser: argparse.ArgumentParser, default: str) -> None:
    parser.add_argument(
        "--methods",
        nargs="+",
        metavar="NAME",
        help=f"methods of `rotavg solve`, combinations A+B, colmap, shonan, oracle (default: {default})",
    )


def _contenders(
    names: Sequence[str] | None, default: Iterable[str], weights: Path | None = None, keep: Path | None = None
) -> dict[str, Contender]:
    """Those asked for, or what can run here of the default."""
    chosen = names if names is not None else [name for name in default if is_available(name)]
    warm_up(tuple(contenders(chosen, weights).values()))
    return contenders(chosen, weights, keep)


def _score(cases: Iterable[Case], chosen: dict[str, Contender], count: int, description: str) -> Scores:
    def watch(steps: Iterable[Step]) -> Iterable[Step]:
        return progress(steps, total=count * len(chosen), description=description, unit="solve")

    return score_all(cases, chosen, watch)


_ROBUSTNESS_METHODS = ("chatterjee", "neurora-paper", "neurora")
_SUITES = (
    _Suite("synthetic", "the paper's synthetic table, and how well outliers are told", _add_synthetic, _run_synthetic),
    _Suite("robustness", "trained on one kind of graph, tested on another", _add_robustness, _run_robustness),
    _Suite("real", "Lund with ground truth, Madrid without, real topologies", _add_real, _run_real),
    _Suite("rgbd", "RGB-D scans, networks cross-validated over the scenes", _add_rgbd, _run_rgbd),
    _Suite(
        "slam",
        "pose graphs with false closures, in one go and edge by edge",
        evaluate_slam.add_arguments,
        evaluate_slam.run,
    ),
)
