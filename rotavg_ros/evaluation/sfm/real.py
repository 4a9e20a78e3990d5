"""Real view-graphs: Lund with ground truth, 1DSfM's Madrid without, and synthetic noise on real topologies."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.datasets.simulation.topology import read_topology
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey, Kind
from rotavg_ros.evaluation.common.contenders import Contender
from rotavg_ros.evaluation.common.score_tables import Figure, averages
from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.evaluation.sfm import synthetic
from rotavg_ros.metrics import true_edge_noise
from rotavg_ros.metrics.orientations import orientation_errors

METHODS = (
    "chatterjee",
    "weiszfeld",
    "arrigoni",
    "wang",
    "cleannet-spt",
    "cleannet-spt-paper",
    "neurora-paper",
    "neurora-v1",
    "neurora-v2",
    "neurora",
    "neurora-without-cycles",
    "geman-mcclure",
    "colmap",
    "shonan",
)
# Methods that take minutes for a graph of 2500 cameras.
SLOW_ON_TOPOLOGIES = ("weiszfeld", "arrigoni", "wang", "shonan")
LUND, MADRID, TOPOLOGIES = "sfm/lund_sphinx.mat", "sfm/madrid_metropolis/EGs.txt", "sfm/topology"
# Noise on the real topologies: the released recipe's, as little as real measurements have, and edges of any rotation
# between cameras that look every way, of which no network of the package has seen any.
NOISE: dict[str, ReleasedRecipe | PaperRecipe] = {
    "the released recipe": ReleasedRecipe(),
    "σ 0.5–3°": ReleasedRecipe(noise_deg=(0.5, 3.0)),
    "σ 2–5° and 20–50 % any rotation, cameras that look every way": PaperRecipe(
        noise_deg=(2.0, 5.0), outlier_share=(0.2, 0.5), planar=False
    ),
}
_STREAM = 0x70B0


_FIGURES = (
    Figure("mean_deg", "mean °", ".3f"),
    Figure("median_deg", "median °", ".3f"),
    Figure("counts.accuracy", "outlier accuracy", ".4f"),
    Figure("cpu_seconds", "CPU s", ".3f"),
)


def lund_case(data: Path) -> Case:
    """The Sphinx of the Lund data sets, with ground truth."""
    graph_file = read_graph(data / LUND)
    assert graph_file.body_from_world_gt is not None
    return Case(CaseKey("Lund, Sphinx"), graph_file.graph, torch.from_numpy(graph_file.body_from_world_gt))


def topology_kinds(data: Path, noise: str) -> list[Kind]:
    """A kind for every real topology: orientations and noise of a recipe of :data:`NOISE` on it."""
    paths = sorted((data / TOPOLOGIES).glob("*.npz"))
    return [Kind(path.stem, partial(_on_topology, path, noise, number)) for number, path in enumerate(paths)]


def _on_topology(path: Path, noise: str, number: int, seed: int) -> Case:
    sample = read_topology(path).sample(NOISE[noise], np.random.default_rng((seed, _STREAM, number)))
    return synthetic.case_of(CaseKey(path.stem, noise, seed), sample)


def madrid_case(data: Path) -> Case:
    """Madrid Metropolis, without ground truth."""
    graph = read_graph(data / MADRID).graph
    unknown = torch.full((graph.num_nodes, 4), torch.nan, dtype=torch.float64)
    return Case(CaseKey("Madrid Metropolis"), graph, unknown)


@dataclass(frozen=True)
class Agreement:
    """Answers to a graph without ground truth (K contenders)."""

    answers: Mapping[str, Answer]
    residual_deg: Mapping[str, np.ndarray]
    difference_deg: np.ndarray  # (K, K) median angle between the orientations of two answers


def agreement(case: Case, chosen: Mapping[str, Contender]) -> Agreement:
    """Solve with every contender and compare the answers with the edges and with each other."""
    solved = {name: contender(case) for name, contender in chosen.items()}
    answers = {name: answer for name, answer in solved.items() if answer is not None}
    residuals = {
        name: np.degrees(true_edge_noise(case.graph, answer.body_from_world).numpy())
        for name, answer in answers.items()
    }
    component = case.graph.components()
    difference = [
        [
            float(torch.rad2deg(orientation_errors(one.body_from_world, other.body_from_world, component)).median())
            for other in answers.values()
        ]
        for one in answers.values()
    ]
    return Agreement(answers, residuals, np.array(difference))


def errors_table(title: str, scores: Scores, names: tuple[str, ...], note: str) -> Table:
    """Errors against the truth, averaged over the cases."""
    return averages(title, scores, [name for name in names if scores.of(name)], _FIGURES, note)


def residual_table(title: str, found: Agreement) -> Table:
    """Residuals of the edges in the answers."""
    rows: list[tuple[Cell, ...]] = [
        (
            name,
            *(float(value) for value in np.percentile(residual, (25, 50, 75))),
            float(residual.mean()),
            100 * float((residual < 5).mean()),
            100 * float((residual > 20).mean()),
            found.answers[name].cpu_seconds,
        )
        for name, residual in found.residual_deg.items()
    ]
    columns = (
        Column("method"),
        Column("lower quartile °", ".2f"),
        Column("median °", ".2f"),
        Column("upper quartile °", ".2f"),
        Column("mean °", ".2f"),
        Column("below 5°, %", ".1f"),
        Column("beyond 20°, %", ".1f"),
        Column("CPU s", ".2f"),
    )
    note = "Residuals of all edges. A least-squares method lowers the mean at the expense of the quartiles."
    return Table(title, columns, tuple(rows), (note,))


def agreement_table(title: str, found: Agreement) -> Table:
    """Median angle between the answers of any two methods."""
    names = tuple(found.answers)
    columns = (Column("median angle between"), *(Column(name, ".2f") for name in names))
    rows: list[tuple[Cell, ...]] = [
        (name, *(None if j == i else float(value) for j, value in enumerate(row)))
        for i, (name, row) in enumerate(zip(names, found.difference_deg, strict=True))
    ]
    return Table(title, columns, tuple(rows), ("Degrees, after one robust global rotation per component.",))
