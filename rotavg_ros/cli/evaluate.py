"""What ``rotavg evaluate`` does: it runs one suite and writes its report."""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path

import torch

from rotavg_ros.cli import evaluate_slam
from rotavg_ros.cli.data_folder import data_folder
from rotavg_ros.cli.progress import progress, working
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import Kind, drawings
from rotavg_ros.evaluation.common.contenders import Contender, contenders, warm_up
from rotavg_ros.evaluation.common.kept_answers import KeptAnswers
from rotavg_ros.evaluation.common.named_peers import is_available
from rotavg_ros.evaluation.common.score_tables import per_case
from rotavg_ros.evaluation.common.scoring import Scores, Step, score_all
from rotavg_ros.evaluation.common.tables import Report, Table
from rotavg_ros.evaluation.sfm import real, rgbd, robustness, robustness_report, synthetic
from rotavg_ros.evaluation.sfm.contenders import ROSTER
from rotavg_ros.evaluation.sfm.published import Configuration
from rotavg_ros.evaluation.sfm.robustness_training import Trained, train
from rotavg_ros.evaluation.sfm.small_training import train_networks
from rotavg_ros.results import make_folder


class EvaluateError(UserError):
    """Options that an evaluation cannot work with."""


def run(arguments: argparse.Namespace) -> int:
    """Run one suite."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    is_new = not arguments.output.exists()
    make_folder(arguments.output)
    try:
        arguments.keep = None if arguments.keep is None else KeptAnswers(arguments.keep)
        print(_RUN[arguments.suite](arguments))
    except UserError:
        if is_new:
            with suppress(OSError):  # something was written
                arguments.output.rmdir()
        raise
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
    scores: dict[str, Scores] = {}
    trained: dict[Configuration, Trained] = {}
    path: Path = arguments.output
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) if arguments.keep is None else arguments.keep.folder / "trained"
        for name in arguments.settings:
            setting = robustness.SETTINGS[name]
            trained[setting.trained] = train(folder, setting.trained, 60 * arguments.minutes, arguments.seed)
            *others, papers = sorted(robustness.methods_of(name), key=lambda method: method == robustness.PAPER)
            chosen = {
                **_contenders((papers,), (), trained[setting.trained].folder),
                **_contenders(others, (), keep=arguments.keep),
            }
            count = robustness.num_graphs(setting.tested, arguments.graphs)
            scores[name] = _score([robustness.kind(setting.tested, arguments.seed)], range(count), chosen, name)
            path = robustness_report.write(arguments.output, scores, trained, arguments.command_line)
            if scores[name].interrupted:
                break
    return path


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
                fit = [method for method in rgbd.UNTRAINED if is_available(method)]
                untrained = contenders(fit, ROSTER, keep=arguments.keep)
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
    """The contenders asked for, or those of the default that can run here."""
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
