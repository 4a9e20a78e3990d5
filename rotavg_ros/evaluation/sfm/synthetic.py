"""The paper's synthetic table (NeuRoRA §5.1), its rows and more, on both recipes, and outlier classification."""

from __future__ import annotations

import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import numpy as np

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph
from rotavg_ros.evaluation.common import plots
from rotavg_ros.evaluation.common.cases import Case, CaseKey, Kind
from rotavg_ros.evaluation.common.score_tables import Figure, average_rows, columns, per_case
from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.common.tables import Cell, Column, Report, Table
from rotavg_ros.evaluation.sfm.contenders import FULL_PIPELINE
from rotavg_ros.evaluation.sfm.published import SYNTHETIC

Recipe = ReleasedRecipe | PaperRecipe
RECIPES: dict[str, Recipe] = {
    "released": ReleasedRecipe(),
    "released-spatial": ReleasedRecipe(planar=False),
    "paper": PaperRecipe(),
}
_RECIPE_TITLES = {
    "released": "the authors' released generator (400–1000 cameras)",
    "released-spatial": "the released generator with axes anywhere, not in a vertical plane",
    "paper": "the recipe of the paper's text (250–1000 cameras)",
}
# What improves a given start step by step, and so what a better start can help.
_BASES = ("chatterjee", "weiszfeld", "wang")
ROWS: dict[str, str] = {
    "chatterjee": "Chatterjee & Govindu (ℓ1 → ℓ½)",
    "weiszfeld": "Weiszfeld ℓ1 (Hartley et al.)",
    "arrigoni": "R-GoDec (Arrigoni et al.)",
    "wang": "LUD (Wang & Singer)",
    "geman-mcclure": "Geman–McClure (ℓ1 → IRLS)",
    "colmap": "COLMAP's rotation averaging",
    "shonan": "Shonan (GTSAM)",
    "spt-paper": "the paper's tree alone",
    "cleannet-spt-paper": "CleanNet-SPT",
    **{f"cleannet-spt-paper+{base}": f"CleanNet-SPT + {base}" for base in _BASES},
    "spt-finenet-paper": "SPT-FineNet",
    **{f"spt-finenet-paper+{base}": f"SPT-FineNet + {base}" for base in _BASES},
    "neurora-paper": "NeuRoRA",
    "neurora-v2-paper": "NeuRoRA-v2",
    **{f"neurora-paper+{base}": f"NeuRoRA + {base}" for base in _BASES},
    "neurora-paper~cleannet": "· with our CleanNet",
    "neurora-paper~tree": "· with our tree",
    "neurora-paper~finenet": "· with our FineNet",
    "neurora-paper~cleannet,tree": "· with our CleanNet and tree",
    "neurora-paper~axes": "· with the cameras' axes of the data",
    "spt": "our tree alone",
    "cleannet-spt": "our CleanNet + tree",
    "spt-finenet": "our tree + FineNet",
    "neurora-v1": "our networks, FineNet once",
    "neurora-v2": "our networks, FineNet twice",
    "neurora": "**full pipeline** (our networks + refinement)",
    "neurora-unweighted": "· without CleanNet's weights",
    "neurora-without-finenet": "· without FineNet",
    "neurora-without-both": "· without both networks",
    "neurora-round": "· without the noise's shape",
    "oracle": "oracle: ℓ½ on the true inliers, from the truth",
    "oracle-shaped": "oracle that is told the noise's shape by the residuals",
    "oracle-covariances": "oracle that is told the covariance of every edge's noise",
}
# Run on every graph; the other rows take minutes per graph or add little, so few graphs are enough for them.
CORE = (
    "chatterjee",
    "geman-mcclure",
    "colmap",
    "cleannet-spt-paper",
    "neurora-paper",
    "neurora-v2-paper",
    "cleannet-spt",
    "neurora-v1",
    "neurora-v2",
    "neurora",
)
# Whose outlier verdicts are compared: scores of ours, residuals of the others.
_CLASSIFIERS = {
    "neurora-paper": "the paper's CleanNet's score",
    "cleannet-spt": "our CleanNet's score",
    "neurora-v1": "our networks' score",
    "neurora": "full pipeline's score",
    "chatterjee": "Chatterjee & Govindu's residuals",
    "colmap": "COLMAP's residuals",
    "oracle": "oracle's residuals",
}
_OUTLIERS = (
    Figure("counts.accuracy", "accuracy", ".4f"),
    Figure("counts.precision", "precision", ".4f"),
    Figure("counts.recall", "recall", ".4f"),
    Figure("roc_area", "ROC area", ".4f"),
)
# Of every graph, in full, for whoever wants to look closer.
PER_GRAPH = (
    Figure("mean_deg", "mean_deg"),
    Figure("median_deg", "median_deg"),
    Figure("cpu_seconds", "cpu_seconds"),
    Figure("counts.accuracy", "accuracy"),
    Figure("counts.precision", "precision"),
    Figure("counts.recall", "recall"),
    Figure("roc_area", "roc_area"),
)
# Keeps these graphs separate from all that training draws.
_STREAM = 0x5EED


def kinds(recipes: Sequence[str], seed: int) -> list[Kind]:
    """One kind per recipe; drawings of a run's ``seed`` are numbered from 0, and do not depend on their number."""
    return [Kind(recipe, partial(_draw, recipe, seed)) for recipe in recipes]


def _draw(recipe: str, seed: int, number: int) -> Case:
    rng = np.random.default_rng((seed, _STREAM, zlib.crc32(recipe.encode()), number))
    sample = RECIPES[recipe].sample(rng)
    return case_of(CaseKey(f"{recipe} {number}", recipe, seed), sample)


def case_of(key: CaseKey, sample: SyntheticGraph) -> Case:
    """A drawn graph, with all that its generator knows."""
    return Case(key, sample.graph, sample.body_from_world, noise_covariance=sample.noise)


@dataclass(frozen=True)
class Results:
    """Scores of every recipe.

    Attributes:
        scores: of ``names``, on every graph.
        more: of ``more_names``, on the first few of the same graphs; may be empty.
    """

    names: Sequence[str]
    scores: Mapping[str, Scores]
    more_names: Sequence[str] = ()
    more: Mapping[str, Scores] = field(default_factory=dict)


def report(folder: Path, results: Results, command: str) -> Path:
    """Write tables and pictures; returns the Markdown file, ``synthetic.md`` or, of one recipe, that one's."""
    tables: dict[str, Table] = {}
    per_graph: dict[str, Table] = {}
    pictures: dict[str, str] = {}
    classifiers = {name: row for name, row in _CLASSIFIERS.items() if name in results.names}
    for recipe, of_recipe in results.scores.items():
        title = _RECIPE_TITLES[recipe]
        tables[f"synthetic-{recipe}"] = _errors(f"Errors on {title}", of_recipe, results.names)
        if recipe in results.more:
            few = Scores()
            few.extend(results.more[recipe])
            few.extend(of_recipe.where(cases=few.cases))
            rows = [name for name in ROWS if name in (*results.names, *results.more_names)]
            tables[f"synthetic-{recipe}-few"] = _errors(
                f"All methods, on the first of these graphs ({recipe})", few, rows
            )
        tables[f"synthetic-{recipe}-outliers"] = classification(f"Outliers on {title}", of_recipe, classifiers)
        per_graph[f"synthetic-{recipe}-graphs"] = per_case(f"Every graph of {title}", of_recipe, PER_GRAPH)
        if not of_recipe.rows:  # interrupted before the first graph was done
            continue
        labels = {name: ROWS.get(name, name).replace("**", "") for name in results.names}
        picture = f"synthetic-{recipe}.png"
        plots.errors(folder / picture, of_recipe, labels, f"Error, recipe {recipe}", reference=FULL_PIPELINE)
        pictures[picture] = f"Mean and median error of every method on {title}; a dot is a graph."
        reliable = {row: of_recipe.calibration[name] for name, row in classifiers.items()}
        if reliable:
            picture = f"synthetic-{recipe}-reliability.png"
            plots.reliability(folder / picture, reliable, f"Reliability of outlier scores, recipe {recipe}")
            pictures[picture] = "Share of outliers among edges of equal score; a calibrated score is on the diagonal."
    introduction = (
        f"`{command}`: mean and median angle between estimated and true orientations after one robust global rotation, "
        "per graph, then averaged over the graphs. Ratios are between averages on the same graphs."
    )
    name = "synthetic" if len(results.scores) > 1 else f"synthetic-{next(iter(results.scores))}"
    return Report(name, "Synthetic view-graphs", introduction, tables, pictures, per_graph).write(folder)


def _errors(title: str, scores: Scores, names: Sequence[str]) -> Table:
    count = len(scores.cases)
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        published = SYNTHETIC.get(name)
        rows.append(
            (
                ROWS.get(name, name),
                *(scores.mean(name, figure) for figure in ("mean_deg", "median_deg", "cpu_seconds")),
                *(scores.ratio(name, FULL_PIPELINE, figure) for figure in ("mean_deg", "median_deg")),
                *(published or [None] * 3),
            )
        )
    short = [f"{ROWS.get(name, name)}: {len(scores.of(name))}" for name in names if len(scores.of(name)) < count]
    notes = [
        f"{count} graphs.",
        "The paper's figures are of 120 graphs of its own and of its machine, drawn by a generator whose text and "
        "released scripts disagree; what it has no figure of is empty.",
    ]
    if short:
        notes.append(f"Graphs solved, where not all {count} (too large, or given up): {'; '.join(short)}.")
    headings = (
        Column("method"),
        Column("mean °", ".2f"),
        Column("median °", ".2f"),
        Column("CPU s", ".2f"),
        Column("mean ÷ full pipeline", ".2f"),
        Column("median ÷ full pipeline", ".2f"),
        Column("paper: mean °", ".2f"),
        Column("paper: median °", ".2f"),
        Column("paper: CPU s", ".2f"),
    )
    return Table(title, headings, tuple(rows), tuple(notes))


def classification(title: str, scores: Scores, classifiers: Mapping[str, str]) -> Table:
    """How well each contender's score detects outliers, per graph, then averaged; calibration over all edges.

    Args:
        classifiers: row title by contender.
    """
    rows = tuple(
        (classifiers[str(name)], *figures, scores.calibration[str(name)].error)
        for name, *figures in average_rows(scores, classifiers, _OUTLIERS)
    )
    note = "An outlier is an edge whose noise exceeds 20°, a verdict a score above one half (residuals: above 20°)."
    return Table(title, (Column("score"), *columns(_OUTLIERS), Column("calibration error", ".4f")), rows, (note,))
