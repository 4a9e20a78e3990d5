"""The page of the paper's robustness check: its ten rows beside ours, and how the networks were trained."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

import numpy as np

from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.common.tables import Cell, Column, Report, Table
from rotavg_ros.evaluation.common.training_plot import draw_together, read_log
from rotavg_ros.evaluation.sfm.published import Configuration, Published, Robustness
from rotavg_ros.evaluation.sfm.robustness import CHATTERJEE, METHODS, PAPER, PIPELINE, SETTINGS
from rotavg_ros.evaluation.sfm.robustness_earlier import EarlierRows, with_earlier
from rotavg_ros.evaluation.sfm.robustness_training import Trained
from rotavg_ros.evaluation.sfm.synthetic import ROWS
from rotavg_ros.solver.networks import PaperCleanNet, PaperFineNet

_TITLES = {
    PAPER: "the paper's NeuRoRA, trained as stated",
    CHATTERJEE: ROWS[CHATTERJEE],
    PIPELINE: "full pipeline, the package's networks",
}
_NETWORKS = {PaperCleanNet.NAME: "CleanNet: loss", PaperFineNet.NAME: "FineNet: mean + median error °"}
_NOT_RUN = "not run"
_FIGURES = ("mean_deg", "median_deg", "cpu_seconds")
_HEADINGS = ("mean °", "median °", "CPU s")
_NOTES = (
    "Kinds of graphs: cameras, share of the pairs, σ at most, outliers. Figures are averages over the graphs. Empty: "
    "the paper has no figure (its authors ran out of memory), or the row was not run.",
    "The paper does not publish this table's generator. Ours is the recipe of its text: a graph's σ is drawn between "
    "5° and what the row states; a random chain joins the cameras, which adds up to one edge for each (at 2.5 % of "
    "the pairs of 1000 cameras the share becomes 2.7 %). Its graphs may be easier or harder; compare ratios rather "
    "than degrees.",
    "The command ran the last rows that were run; others are of runs before it.",
)
_TRAINING_NOTE = (
    "Minutes on the CPU, both networks together. Losses and edge dropout (25 %) are the paper's; its learning rate "
    "(ours begins at 1e-3 and falls to zero) and the length of its training are not. The weights of the best "
    "validation are kept."
)


def write(folder: Path, scores: Mapping[str, Scores], trained: Mapping[Configuration, Trained], command: str) -> Path:
    """Write the page, its tables and the picture of training; returns the Markdown file.

    Rows of other settings on a page in the folder are kept, and so are trainings of other configurations.

    Args:
        scores: by setting; missing ones were not run.
        trained: the networks of their configurations.
    """
    introduction = (
        f"`{command}`: the ten rows of the paper's robustness check ([its table 3](published.md#table-3-robustness)), "
        "the paper's NeuRoRA trained on one kind of graph and tested on another. Degrees as in the synthetic table."
    )
    headings = (
        *map(Column, ("what varies", "trained on", "tested on", "method")),
        *(Column(heading, ".2f") for heading in _HEADINGS),
        *(Column(f"paper: {heading}", ".1f") for heading in _HEADINGS),
        Column("graphs", "d"),
    )
    of_row = (0, 1, 2, 3)
    earlier = EarlierRows.of(folder, "robustness", headings).by(*of_row)
    earlier = {key: row for key, row in earlier.items() if row[-1] != _NOT_RUN}
    rows: list[tuple[Cell, ...]] = []
    for name, setting in SETTINGS.items():
        scored = scores.get(name, Scores(interrupted=True))
        found = _rows(setting, scored)
        rows += [earlier.get(row[: len(of_row)], row) for row in found] if scored.interrupted else found
    tables = {
        "robustness": Table("Robustness", headings, tuple(rows), _NOTES),
        "robustness-training": with_earlier(folder, "robustness-training", _training(trained), 0),
    }
    curves = with_earlier(folder, "robustness-curves", _curves(trained), 0, 1)
    draw_together(folder / "robustness-training.png", _by_network(curves))
    pictures = {
        "robustness-training.png": "Validation over the course of training; a dot is the epoch whose weights are kept."
    }
    long = {"robustness-curves": curves}
    return Report("robustness", "Robustness", introduction, tables, pictures, long).write(folder)


def _rows(setting: Robustness, scores: Scores) -> list[tuple[Cell, ...]]:
    published: dict[str, Published | None] = {PAPER: setting.neurora, CHATTERJEE: setting.chatterjee}
    rows: list[tuple[Cell, ...]] = []
    for name in METHODS:
        count: Cell = len(scores.of(name)) if scores.rows else _NOT_RUN
        figures = (scores.mean(name, figure) for figure in _FIGURES)
        theirs = published.get(name) or (None,) * len(_FIGURES)
        rows.append(
            (setting.varied, str(setting.trained), str(setting.tested), _TITLES[name], *figures, *theirs, count)
        )
    return rows


def _training(trained: Mapping[Configuration, Trained]) -> Table:
    headings = (
        Column("trained on"),
        Column("graphs", "d"),
        Column("minutes", ".1f"),
        *(Column(f"{title.split(':')[0]}: epochs", "d") for title in _NETWORKS.values()),
        *(Column(f"{title}, best", ".3f") for title in _NETWORKS.values()),
    )
    rows: list[tuple[Cell, ...]] = []
    for configuration, each in trained.items():
        epochs = (run.epochs for run in each.runs.values())
        best = (float(read_log(each.log(name))[1].min()) for name in _NETWORKS)
        rows.append((str(configuration), each.graphs, each.minutes, *epochs, *best))
    return Table("Training", headings, tuple(rows), (_TRAINING_NOTE,))


def _curves(trained: Mapping[Configuration, Trained]) -> Table:
    """Validation after every epoch."""
    rows = tuple(
        (str(configuration), network, int(epoch), float(objective))
        for configuration, each in trained.items()
        for network in _NETWORKS
        for epoch, objective in zip(*read_log(each.log(network)), strict=True)
    )
    return Table("", tuple(map(Column, ("trained on", "network", "epoch", "validation"))), rows)


def _by_network(curves: Table) -> dict[str, dict[str, tuple[np.ndarray, np.ndarray]]]:
    """Epochs and validations of each run, by the network's title and what it was trained on."""
    found: dict[str, dict[str, list[tuple[float, float]]]] = {title: {} for title in _NETWORKS.values()}
    for of, network, epoch, validation in curves.rows:
        if network not in _NETWORKS:  # of somebody's own in the folder's file
            continue
        found[_NETWORKS[str(network)]].setdefault(str(of), []).append((float(epoch or 0), float(validation or 0)))
    return {title: {of: tuple(np.array(run).T) for of, run in runs.items()} for title, runs in found.items()}
