"""RGB-D scans: every scene is solved by networks that were trained on other scenes of its kind (cross-validation)."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.rgbd import read_scene
from rotavg_ros.datasets.simulation.synthetic import SyntheticGraph
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.score_tables import Figure, average_rows, columns
from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.training.sfm_tasks import GivenGraphs

# Methods that are not trained, and those that are trained in every fold.
UNTRAINED = (
    *("chatterjee", "weiszfeld", "geman-mcclure", "colmap", "shonan"),
    *("neurora-equal-precisions", "neurora-without-consensus", "oracle"),
)
TRAINED = ("cleannet-spt", "neurora-v1", "neurora")
# Prefix of the name of a method with the package's own networks.
PACKAGE_PREFIX = "package: "
# One in this many of a fold's training scenes is for validation, which decides which weights are kept.
_VALIDATION_STRIDE = 6
_FIGURES = (
    Figure("mean_deg", "mean °", ".1f"),
    Figure("median_deg", "median °", ".1f"),
    Figure("counts.accuracy", "outlier accuracy", ".3f"),
    Figure("roc_area", "ROC area", ".3f"),
    Figure("cpu_seconds", "CPU s", ".3f"),
)


class RgbdEvaluationError(UserError):
    """Scenes that cannot be cross-validated."""


@dataclass(frozen=True)
class Fold:
    """Scenes to test on, and the scenes that the networks for them are trained on."""

    test: tuple[Case, ...]
    training: GivenGraphs


def folds(folder: Path, count: int, max_scenes: int | None) -> Iterator[Fold]:
    """Split the scenes of a folder into ``count`` parts, each of which is tested once.

    Raises:
        RgbdEvaluationError: fewer scenes than two per fold.
    """
    cases = [_read(path) for path in sorted(folder.glob("*.npz"))[:max_scenes]]
    if len(cases) < 2 * count:
        raise RgbdEvaluationError(f"{folder}: {len(cases)} scenes are too few for {count} folds; need two per fold")
    order = np.random.default_rng(0).permutation(len(cases))
    for part in np.array_split(order, count):
        others = [_training_graph(cases[index]) for index in order if index not in part]
        validation = others[::_VALIDATION_STRIDE]
        training = [graph for number, graph in enumerate(others) if number % _VALIDATION_STRIDE]
        yield Fold(tuple(cases[index] for index in part), GivenGraphs(training, validation))


def table(title: str, scores: Scores, minutes: float) -> Table:
    """Errors over all scenes, each solved in the fold that had not seen it."""
    names = (*UNTRAINED, *(PACKAGE_PREFIX + name for name in TRAINED), *TRAINED)
    names = tuple(name for name in names if scores.of(name))
    rows = tuple(
        (*row, scores.calibration[str(row[0])].error, len(scores.of(str(row[0]))))
        for row in average_rows(scores, names, _FIGURES)
    )
    note = (
        f"The networks of each fold went on from the package's for {minutes:g} minutes on one CPU core, on the other "
        "scenes; package: as they come, trained on synthetic graphs alone."
    )
    headings = (Column("method"), *columns(_FIGURES), Column("calibration error", ".3f"), Column("scenes", "d"))
    return Table(title, headings, rows, (note,))


def _read(path: Path) -> Case:
    graph_file = read_scene(path).graph_file
    assert graph_file.body_from_world_gt is not None
    return Case(CaseKey(path.stem), graph_file.graph, torch.from_numpy(graph_file.body_from_world_gt))


def _training_graph(case: Case) -> SyntheticGraph:
    return SyntheticGraph(case.graph, case.truth, case.noise)
