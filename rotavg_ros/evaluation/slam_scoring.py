"""Run contenders on pose graphs and score what they answer: errors, ratios to the oracle, verdicts, speed."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.stats import gmean

from rotavg_ros.evaluation.metrics import OutlierCounts, orientation_errors
from rotavg_ros.evaluation.slam_cases import SlamCase
from rotavg_ros.evaluation.slam_contenders import SlamAnswer, SlamContender

REFERENCE = "oracle"


@dataclass(frozen=True)
class SlamScore:
    """One contender on one case.

    Attributes:
        error_deg: mean over the nodes, after one robust global rotation per component.
        floored_deg: the same, no smaller than the case's floor.
        counts: verdicts on loop closures that are clearly good or false.
        odometry_flagged: odometry edges that are called outliers though they are good.
    """

    case: str
    graph_name: str
    condition: str
    seed: int
    contender: str
    error_deg: float
    floored_deg: float
    counts: OutlierCounts
    odometry_flagged: int
    cpu_seconds: float


def score(case: SlamCase, name: str, answer: SlamAnswer) -> SlamScore:
    """One answer against what is known of the case."""
    errors = orientation_errors(answer.body_from_world, case.truth, case.graph.components()).numpy()
    error_deg = float(np.degrees(np.nanmean(errors)))
    decided = case.is_false | case.is_good
    return SlamScore(
        case.name,
        case.graph_name,
        case.condition,
        case.seed,
        name,
        error_deg,
        max(error_deg, float(np.degrees(case.floor))),
        OutlierCounts.of(answer.is_outlier[decided], case.is_false[decided]),
        int((answer.is_outlier & ~case.is_closure & case.is_inlier).sum()),
        answer.cpu_seconds,
    )


Step = tuple[SlamCase, str, SlamContender]


def score_all(
    cases: Iterable[SlamCase],
    chosen: Mapping[str, SlamContender],
    watch: Callable[[Iterable[Step]], Iterable[Step]] = lambda steps: steps,
) -> SlamScores:
    """Every contender on every case.

    Args:
        watch: passes the steps through, one per solve, and may show how far they are.
    """
    rows = []
    for case, name, contender in watch(_steps(cases, chosen)):
        answer = contender(case)
        if answer is not None:
            rows.append(score(case, name, answer))
    return SlamScores(tuple(rows))


def _steps(cases: Iterable[SlamCase], chosen: Mapping[str, SlamContender]) -> Iterator[Step]:
    for case in cases:
        for name, contender in chosen.items():
            yield case, name, contender


@dataclass(frozen=True)
class SlamScores:
    """All scores of a run, and what they come to."""

    rows: tuple[SlamScore, ...]

    def where(self, contender: str, graphs: Sequence[str] | None = None, condition: str | None = None) -> SlamScores:
        """Those of one contender, on some graphs, under one condition."""
        return SlamScores(
            tuple(
                row
                for row in self.rows
                if row.contender == contender
                and (graphs is None or row.graph_name in graphs)
                and (condition is None or row.condition == condition)
            )
        )

    @property
    def conditions(self) -> tuple[str, ...]:
        """In the order of their first rows."""
        return tuple(dict.fromkeys(row.condition for row in self.rows))

    @property
    def graphs(self) -> tuple[str, ...]:
        """In the order of their first rows."""
        return tuple(dict.fromkeys(row.graph_name for row in self.rows))

    def ratios(self, contender: str, graphs: Sequence[str], condition: str | None = None) -> dict[str, float]:
        """Error over the oracle's, both no smaller than the floor, by case."""
        oracle = {row.case: row.floored_deg for row in self.where(REFERENCE).rows}
        rows = self.where(contender, graphs, condition).rows
        return {row.case: row.floored_deg / oracle[row.case] for row in rows if row.case in oracle}

    def speed_ratios(self, contender: str, other: str) -> dict[str, tuple[float, float]]:
        """Seconds of both by case, where both answered."""
        theirs = {row.case: row.cpu_seconds for row in self.where(other).rows}
        ours = {row.case: row.cpu_seconds for row in self.where(contender).rows}
        return {case: (ours[case], theirs[case]) for case in ours if case in theirs}

    def mean(self, figure: str) -> float:
        """Mean of a figure over all rows; NaN without rows."""
        return float(np.mean([getattr(row, figure) for row in self.rows])) if self.rows else float("nan")

    def counts(self) -> OutlierCounts:
        """Verdicts of all rows together."""
        figures = ("true_positives", "false_positives", "false_negatives", "true_negatives")
        return OutlierCounts(*(sum(getattr(row.counts, figure) for row in self.rows) for figure in figures))


def geometric_mean(values: Iterable[float]) -> float:
    """NaN of nothing."""
    collected = list(values)
    return float(gmean(collected)) if collected else float("nan")


def good_flagged(counts: OutlierCounts) -> float:
    """Share of the good closures that are called false; 0 if there is none."""
    good = counts.false_positives + counts.true_negatives
    return counts.false_positives / good if good else 0.0
