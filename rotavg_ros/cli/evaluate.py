"""What ``rotavg evaluate`` does: it runs one suite and writes its report."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path

import torch

from rotavg_ros.cli import evaluate_slam
from rotavg_ros.cli.data_folder import data_folder
from rotavg_ros.cli.options.evaluate import ROBUSTNESS_METHODS
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


def run(arguments: argparse.Namespace) -> int:
    """Run one suite."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    make_folder(arguments.output)
    if arguments.keep is not None:
        make_folder(arguments.keep)
    print(_RUN[arguments.suite](arguments))
    return 0


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


def _run_robustness(arguments: argparse.Namespace) -> Path:
    names = tuple(arguments.methods or ROBUSTNESS_METHODS)
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


def _contenders(
    names: Sequence[str] | None, default: Iterable[str], weights: Path | None = None, keep: Path | None = None
) -> dict[str, Contender]:
    """Those asked for, or what can run here of the default."""
    chosen = names if names is not None else [name for name in default if is_available(name)]
    with working("warming up"):
        warm_up(tuple(contenders(chosen, weights).values()))
    return contenders(chosen, weights, keep)


def _score(cases: Iterable[Case], chosen: dict[str, Contender], count: int, description: str) -> Scores:
    def watch(steps: Iterable[Step]) -> Iterable[Step]:
        return progress(steps, total=count * len(chosen), description=description, unit="solve")

    return score_all(cases, chosen, watch)


_RUN: dict[str, Callable[[argparse.Namespace], Path]] = {
    "synthetic": _run_synthetic,
    "robustness": _run_robustness,
    "real": _run_real,
    "rgbd": _run_rgbd,
    "slam": evaluate_slam.run,
}
