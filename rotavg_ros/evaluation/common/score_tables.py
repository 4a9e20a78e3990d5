"""Tables of scores: averages by contender, and a row for every case."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from operator import attrgetter
from typing import NamedTuple

from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.metrics import OutlierCounts


class Figure(NamedTuple):
    """A figure of :class:`rotavg_ros.evaluation.common.scoring.Score`, its heading and its number format."""

    path: str
    heading: str
    format: str = ""


def columns(figures: Iterable[Figure]) -> tuple[Column, ...]:
    """One column per figure."""
    return tuple(Column(figure.heading, figure.format) for figure in figures)


def average_rows(scores: Scores, names: Iterable[str], figures: Sequence[Figure]) -> list[tuple[Cell, ...]]:
    """One row per contender: its name, and its averages over the cases that it solved."""
    return [(name, *(scores.mean(name, figure.path) for figure in figures)) for name in names]


def averages(title: str, scores: Scores, names: Iterable[str], figures: Sequence[Figure], *notes: str) -> Table:
    """Averages of every contender."""
    return Table(title, (Column("method"), *columns(figures)), tuple(average_rows(scores, names, figures)), notes)


def precision_and_recall(counts: OutlierCounts) -> tuple[Cell, Cell]:
    """Cells of verdicts; empty where no edge is an outlier: one flag would make 0 of the precision, none 1 of both."""
    return (counts.precision, counts.recall) if counts.num_outliers else (None, None)


def good_flagged(counts: OutlierCounts) -> float | None:
    """Share of the good edges that are flagged, as a cell: empty where there is none."""
    return counts.false_alarm_rate if counts.num_inliers else None


# Verdicts on a case, and what they cost.
VERDICT_FIGURES = (
    Figure("counts.true_positives", "false_flagged"),
    Figure("counts.false_positives", "good_flagged"),
    Figure("counts.false_negatives", "false_kept"),
    Figure("counts.true_negatives", "good_kept"),
    Figure("odometry_flagged", "odometry_flagged"),
    Figure("cpu_seconds", "cpu_seconds"),
)


def per_case(title: str, scores: Scores, figures: Sequence[Figure], key: Mapping[str, str] | None = None) -> Table:
    """A row for every case and method.

    Args:
        key: columns that identify the case: attribute of :class:`~rotavg_ros.evaluation.common.cases.CaseKey` by
            heading; default: only the graph's name.
    """
    key = key or {"graph": "name"}
    rows = tuple(
        (
            *(getattr(row.case, attribute) for attribute in key.values()),
            row.contender,
            *(attrgetter(figure.path)(row) for figure in figures),
        )
        for row in scores.rows
    )
    return Table(title, (*map(Column, key), Column("method"), *columns(figures)), rows)
