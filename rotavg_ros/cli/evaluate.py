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
from rotavg_ros.evaluation.common.cases import Kind, drawings
from rotavg_ros.evaluation.common.contenders import Contender, contenders, warm_up
from rotavg_ros.evaluation.common.kept_answers import KeptAnswers
from rotavg_ros.evaluation.common.named_peers import is_available
from rotavg_ros.evaluation.common.score_tables import per_case
from rotavg_ros.evaluation.common.scoring import Scores, Step, score_all
from rotavg_ros.evaluation.common.tables import Report, Table
from rotavg_ros.evaluation.sfm import real, rgbd, robustness, synthetic
from rotavg_ros.evaluation.sfm.contenders import ROSTER
from rotavg_ros.evaluation.sfm.small_training import train_networks
from rotavg_ros.results import make_folder


class EvaluateError(UserError):
    """Options that an evaluation cannot work with."""


def run(arguments: argparse.Namespace) -> int:
    """Run one suite."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    make_folder(arguments.output)
    arguments.keep = None if arguments.keep is None else KeptAnswers(arguments.keep)
    print(_RUN[arguments.suite](arguments))
    return 0


def _run_synthetic(arguments: argparse.Namespace) -> Path:
    core = _contenders(arguments.methods, synthetic.CORE, keep=arguments.keep)
    few = min(arguments.few_graphs, arguments.graphs)
    is_all = arguments.methods is not None or few == 0
    others = [name for name in synthetic.ROWS if name not in synthetic.CORE]
    more = {} if is_all else _contenders(None, others, keep=arguments.keep)
    scores, scores_of_few = {}, {}
    for kind in synthetic.kinds(arguments.recipes, arguments.seed):
        scores[kind.name] = _score([kind], range(arguments.graphs), core, kind.name)
        if more:
            scores_of_few[kind.name] = _score([kind], range(few), more, f"{kind.name}, more methods")
    results = synthetic.Results(tuple(core), scores, tuple(more), scores_of_few)
    with working("writing the report"):
        return synthetic.report(arguments.output, results, arguments.command_line)


def _run_robustness(arguments: argparse.Namespace) -> Path:
    names = tuple(arguments.methods or ROBUSTNESS_METHODS)
    contenders(names, ROSTER)  # mistakes show before any training
    scores = {}
    with tempfile.TemporaryDirectory() as folder:
        trained = {robustness.SETTINGS[setting].training for setting in arguments.settings} - {robustness.PACKAGE}
        for training in sorted(trained):
            with working(f"drawing the graphs to train on ({training})"):
                graphs = robustness.training_graphs(training, arguments.seed)
            train_networks(Path(folder) / training, graphs, 60 * arguments.minutes)
        for setting in arguments.settings:
            training = robustness.SETTINGS[setting].training
            weights = None if training == robustness.PACKAGE else Path(folder) / training
            fit = [name for name in names if robustness.is_fit(setting, name)]
            chosen = _contenders(fit, (), weights, arguments.keep)
            count = robustness.num_graphs(setting, arguments.graphs)
            scores[setting] = _score([robustness.kind(setting, arguments.seed)], range(count), chosen, setting)
    with working("writing the report"):
        return robustness.report(arguments.output, scores, names, arguments.command_line)


def _run_real(arguments: argparse.Namespace) -> Path:
    data = data_folder(arguments, (real.LUND, real.MADRID, real.TOPOLOGIES))
    chosen = _contenders(arguments.methods, real.METHODS, keep=arguments.keep)
    with working("reading"):
        lund, madrid = real.lund_case(data), real.madrid_case(data)
    on_lund = score_all([lund], chosen, _watch(len(chosen), lund.key.name))
    fast = {name: contender for name, contender in chosen.items() if name not in real.SLOW_ON_TOPOLOGIES}
    on_topologies = {}
    for noise in real.NOISE:
        kinds = real.topology_kinds(data, noise)
        on_topologies[noise] = _score(kinds, [arguments.seed], fast, f"real topologies, {noise}")
    with working(madrid.key.name):
        found = real.agreement(madrid, chosen)
    names = tuple(chosen)
    tables: dict[str, Table] = {
        "real-lund": real.errors_table(lund.key.name, on_lund, names, "70 cameras, 1207 edges; ground truth."),
    }
    graphs = {}
    for number, (noise, scores) in enumerate(on_topologies.items(), 1):
        title = f"1DSfM topologies, noise of {noise}"
        note = f"{len(scores.cases)} real topologies; without what takes minutes a graph."
        tables[f"real-topologies-{number}"] = real.errors_table(title, scores, names, note)
        graphs[f"real-topologies-{number}-graphs"] = per_case(title, scores, synthetic.PER_GRAPH)
    tables["real-madrid-residuals"] = real.residual_table(madrid.key.name, found)
    tables["real-madrid-agreement"] = real.agreement_table(f"{madrid.key.name}: who agrees with whom", found)
    introduction = f"`{arguments.command_line}`"
    with working("writing the report"):
        return Report("real", "Real view-graphs", introduction, tables, extra_csv=graphs).write(arguments.output)


def _run_rgbd(arguments: argparse.Namespace) -> Path:
    data = data_folder(arguments, [f"rgbd/{name}" for name in arguments.sets])
    if arguments.folds < 2:
        raise EvaluateError("--folds must be 2 or more: what is tested must not be trained on")
    with working("reading"):
        split = {
            name: list(rgbd.folds(data / "rgbd" / name, arguments.folds, arguments.scenes)) for name in arguments.sets
        }
    tables = {}
    for name, folds in split.items():
        scores = Scores()
        for fold in progress(folds, description=name, unit="fold"):
            with tempfile.TemporaryDirectory() as folder:
                train_networks(Path(folder), fold.training, 60 * arguments.minutes, from_package=True)
                trained = contenders(rgbd.TRAINED, ROSTER, Path(folder))
                own = contenders(rgbd.TRAINED, ROSTER, keep=arguments.keep)
                own = {rgbd.PACKAGE_PREFIX + method: contender for method, contender in own.items()}
                untrained = contenders(rgbd.UNTRAINED, ROSTER, keep=arguments.keep)
                scores.extend(score_all(fold.test, {**untrained, **own, **trained}))
        tables[f"rgbd-{name}"] = rgbd.table(name, scores, arguments.minutes)
    introduction = (
        f"`{arguments.command_line}`: scans registered pairwise, most of the registrations wrong; degrees per scene, "
        "averaged."
    )
    with working("writing the report"):
        return Report("rgbd", "RGB-D scans", introduction, tables).write(arguments.output)


def _contenders(
    names: Sequence[str] | None,
    default: Iterable[str],
    weights: Path | None = None,
    keep: KeptAnswers | None = None,
) -> dict[str, Contender]:
    """Those asked for, or what can run here of the default."""
    chosen = names if names is not None else [name for name in default if is_available(name)]
    with working("warming up"):
        warm_up(contenders(chosen, ROSTER, weights).values(), ROSTER)
    return contenders(chosen, ROSTER, weights, keep)


def _score(kinds: Sequence[Kind], seeds: Sequence[int], chosen: dict[str, Contender], description: str) -> Scores:
    solves = len(kinds) * len(seeds) * len(chosen)
    return score_all(drawings(kinds, seeds), chosen, _watch(solves, description))


def _watch(solves: int, description: str) -> Callable[[Iterable[Step]], Iterable[Step]]:
    return lambda steps: progress(steps, total=solves, description=description, unit="solve")


_RUN: dict[str, Callable[[argparse.Namespace], Path]] = {
    "synthetic": _run_synthetic,
    "robustness": _run_robustness,
    "real": _run_real,
    "rgbd": _run_rgbd,
    "slam": evaluate_slam.run,
}
