"""Run contenders on cases and score what they answer: errors in degrees, outlier verdicts, calibration."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

import numpy as np
import torch
from scipy.stats import rankdata

from rotavg_ros.datasets.simulation.synthetic import SFM_OUTLIER_ANGLE
from rotavg_ros.evaluation.calibration import CalibrationBins
from rotavg_ros.evaluation.contenders import Answer, Case, Contender
from rotavg_ros.evaluation.metrics import OutlierCounts, orientation_errors


@dataclass(frozen=True)
class Score:
    """One contender on one case.

    Attributes:
        mean_deg, median_deg: errors of the orientations after one robust global rotation per component.
        accuracy, precision, recall: of calling edges outliers (noise beyond 20°) whose score exceeds one half.
        roc_area: area under the receiver operating characteristic of the score; NaN without outliers or inliers.
    """

    case: str
    contender: str
    mean_deg: float
    median_deg: float
    cpu_seconds: float
    accuracy: float
    precision: float
    recall: float
    roc_area: float


@dataclass
class Scores:
    """All scores of a run, and how well each contender's outlier scores are calibrated over all its cases."""

    rows: list[Score] = field(default_factory=list)
    calibration: dict[str, CalibrationBins] = field(default_factory=dict)

    def extend(self, other: Scores) -> None:
        """Take in the scores of further cases."""
        self.rows += other.rows
        for name, bins in other.calibration.items():
            self.calibration.setdefault(name, CalibrationBins()).extend(bins)

    def on(self, cases: Collection[str]) -> Scores:
        """The scores of some cases alone, without calibration."""
        return Scores([row for row in self.rows if row.case in cases])

    def of(self, contender: str) -> dict[str, Score]:
        """A contender's scores by case."""
        return {row.case: row for row in self.rows if row.contender == contender}

    def mean(self, contender: str, figure: str) -> float:
        """Mean of a figure over the cases that the contender solved; NaN if it solved none."""
        values = [getattr(row, figure) for row in self.of(contender).values()]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

    def ratio(self, contender: str, reference: str, figure: str) -> float:
        """Mean of a figure over that of the reference, on the cases that both solved."""
        ours, theirs = self.of(contender), self.of(reference)
        both = ours.keys() & theirs.keys()
        below = sum(getattr(theirs[case], figure) for case in both)
        return sum(getattr(ours[case], figure) for case in both) / below if below > 0 else float("nan")


Step = tuple[Case, str, Contender]


def score_all(
    cases: Iterable[Case],
    chosen: Mapping[str, Contender],
    watch: Callable[[Iterable[Step]], Iterable[Step]] = lambda steps: steps,
) -> Scores:
    """Every contender on every case. An interruption (Ctrl-C) ends it after the last case that all have solved.

    Args:
        watch: passes the steps through, one per solve, and may show how far they are.
    """
    scores, of_case = Scores(calibration={name: CalibrationBins() for name in chosen}), Scores()
    with suppress(KeyboardInterrupt):
        for number, (case, name, contender) in enumerate(watch(_steps(cases, chosen)), 1):
            answer = contender(case)
            if answer is not None:
                of_case.rows.append(score(case, name, answer))
                known = torch.isfinite(case.noise_angle)
                is_outlier = case.noise_angle[known] > SFM_OUTLIER_ANGLE
                bins = of_case.calibration.setdefault(name, CalibrationBins())
                bins.add(answer.outlier_score[known], is_outlier)
            if number % len(chosen) == 0:
                scores.extend(of_case)
                of_case = Scores()
    return scores


def _steps(cases: Iterable[Case], chosen: Mapping[str, Contender]) -> Iterator[Step]:
    for case in cases:
        for name, contender in chosen.items():
            yield case, name, contender


def score(case: Case, name: str, answer: Answer) -> Score:
    """One answer against the truth."""
    errors = orientation_errors(answer.body_from_world, case.truth, case.graph.components())
    errors_deg = np.degrees(errors[torch.isfinite(errors)].numpy())
    known = torch.isfinite(case.noise_angle)
    is_outlier = case.noise_angle[known] > SFM_OUTLIER_ANGLE
    outlier_score = answer.outlier_score[known]
    counts = OutlierCounts.of(outlier_score > 0.5, is_outlier)
    return Score(
        case.name,
        name,
        float(errors_deg.mean()),
        float(np.median(errors_deg)),
        answer.cpu_seconds,
        counts.accuracy,
        counts.precision,
        counts.recall,
        roc_area(outlier_score.numpy(), is_outlier.numpy()),
    )


def roc_area(value: np.ndarray, is_positive: np.ndarray) -> float:
    """Probability that a positive's value exceeds a negative's, ties counting half (Mann–Whitney).

    Args:
        value: ``(M,)``; is_positive: ``(M,)`` bool.
    """
    positives = int(is_positive.sum())
    negatives = len(is_positive) - positives
    if positives == 0 or negatives == 0:
        return float("nan")
    rank_sum = rankdata(value)[is_positive].sum()
    return float((rank_sum - positives * (positives + 1) / 2) / (positives * negatives))
