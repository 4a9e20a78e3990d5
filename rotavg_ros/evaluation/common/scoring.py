"""Run contenders on cases and score their answers: errors in degrees, verdicts on edges, calibration."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from operator import attrgetter

import numpy as np
import torch
from scipy.stats import gmean

from rotavg_ros.errors import until_interrupted
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.contenders import Contender
from rotavg_ros.metrics import CalibrationBins, OutlierCounts, orientation_errors, position_errors, roc_area


@dataclass(frozen=True)
class Score:
    """One contender on one case.

    Attributes:
        mean_deg, median_deg: errors of the orientations after one robust global rotation per component.
        floored_deg: the mean, no smaller than the case's floor.
        counts: verdicts (a score above one half) on edges that are clearly good or false.
        roc_area: area under the receiver operating characteristic of the score on these edges; NaN without outliers
            or inliers.
        odometry_flagged: odometry edges that are called outliers though they are good.
        ate_m: root mean square error of the positions after rigid alignment without scale; NaN where unknown.
        floored_m: the same, no smaller than the floor.
    """

    case: CaseKey
    contender: str
    mean_deg: float
    median_deg: float
    floored_deg: float
    counts: OutlierCounts
    roc_area: float
    odometry_flagged: int
    cpu_seconds: float
    ate_m: float = float("nan")
    floored_m: float = float("nan")

    def figure(self, path: str) -> float:
        """An attribute, or one of an attribute: ``mean_deg``, ``counts.recall``."""
        return float(attrgetter(path)(self))


def score(case: Case, name: str, answer: Answer) -> Score:
    """Score an answer with judged edges against the case's truth."""
    assert answer.outlier_score is not None
    errors = orientation_errors(answer.body_from_world, case.truth, case.graph.components())
    errors_deg = np.degrees(errors[torch.isfinite(errors)].numpy())
    mean_deg = float(errors_deg.mean())
    decided = case.is_false | case.is_good
    is_outlier, is_flagged = case.is_false[decided], answer.outlier_score > 0.5
    return Score(
        case.key,
        name,
        mean_deg,
        float(np.median(errors_deg)),
        max(mean_deg, float(np.degrees(case.floor))),
        OutlierCounts.of(is_flagged[decided], is_outlier),
        roc_area(answer.outlier_score[decided].numpy(), is_outlier.numpy()),
        int((is_flagged & ~case.is_closure & case.is_inlier).sum()),
        answer.cpu_seconds,
        *_position_errors(case, answer),
    )


def _position_errors(case: Case, answer: Answer) -> tuple[float, float]:
    """Root mean square error in metres: the plain value, and one no smaller than the floor."""
    if case.poses is None or answer.position is None:
        return float("nan"), float("nan")
    errors = position_errors(answer.position.numpy(), case.poses.position.numpy())
    ate = float(np.sqrt(np.nanmean(errors**2)))
    return ate, max(ate, case.poses.floor)


@dataclass
class Scores:
    """The scores of a run, in the order in which they came.

    Attributes:
        rows: the scores.
        calibration: by contender, of its scores of clearly good and false edges over all its cases.
        interrupted: by Ctrl-C; the cases after it are missing.
    """

    rows: list[Score] = field(default_factory=list)
    calibration: dict[str, CalibrationBins] = field(default_factory=dict)
    interrupted: bool = False

    def extend(self, other: Scores) -> None:
        """Add the scores of further cases."""
        self.rows += other.rows
        self.interrupted |= other.interrupted
        for name, bins in other.calibration.items():
            self.calibration.setdefault(name, CalibrationBins()).extend(bins)

    def where(
        self,
        contender: str | None = None,
        names: Collection[str] | None = None,
        kind: str | None = None,
        cases: Collection[CaseKey] | None = None,
    ) -> Scores:
        """The scores of one contender, on some graphs, of one kind, on some cases; without calibration."""
        rows = (row for row in self.rows if contender is None or row.contender == contender)
        rows = (row for row in rows if names is None or row.case.name in names)
        rows = (row for row in rows if kind is None or row.case.kind == kind)
        return Scores([row for row in rows if cases is None or row.case in cases])

    @property
    def cases(self) -> tuple[CaseKey, ...]:
        """In the order of their first rows, as names and kinds."""
        return tuple(dict.fromkeys(row.case for row in self.rows))

    @property
    def names(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(row.case.name for row in self.rows))

    @property
    def kinds(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(row.case.kind for row in self.rows))

    @property
    def contenders(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(row.contender for row in self.rows))

    def of(self, contender: str) -> dict[CaseKey, Score]:
        """A contender's scores by case."""
        return {row.case: row for row in self.rows if row.contender == contender}

    def mean(self, contender: str, figure: str) -> float:
        """Mean of a figure over the cases that the contender solved; NaN if it solved none."""
        values = [row.figure(figure) for row in self.of(contender).values()]
        return float(np.nanmean(values)) if np.isfinite(values).any() else float("nan")

    def ratios(self, contender: str, reference: str, figure: str, kind: str | None = None) -> dict[CaseKey, float]:
        """A figure over the reference's, by case (of one kind) that both solved."""
        ours, theirs = self.of(contender), self.of(reference)
        both = [case for case in ours if case in theirs and kind in (None, case.kind)]
        return {case: ours[case].figure(figure) / theirs[case].figure(figure) for case in both}

    def ratio(self, contender: str, reference: str, figure: str) -> float:
        """Mean of a figure over that of the reference, on the cases that both solved."""
        ours, theirs = self.of(contender), self.of(reference)
        both = ours.keys() & theirs.keys()
        below = sum(theirs[case].figure(figure) for case in both)
        return sum(ours[case].figure(figure) for case in both) / below if below > 0 else float("nan")

    def counts(self) -> OutlierCounts:
        """Verdicts of all rows together."""
        return sum((row.counts for row in self.rows), OutlierCounts(0, 0, 0, 0))


Step = tuple[Case, str, Contender]


def score_all(
    cases: Iterable[Case],
    chosen: Mapping[str, Contender],
    watch: Callable[[Iterable[Step]], Iterable[Step]] = lambda steps: steps,
) -> Scores:
    """Every contender on every case. An interruption (Ctrl-C) ends it after the last case that all have solved.

    Args:
        watch: passes the steps through, one per solve, and may show the progress.
    """
    scores = Scores(calibration={name: CalibrationBins() for name in chosen}, interrupted=True)
    of_case = Scores()
    with until_interrupted():
        for number, (case, name, contender) in enumerate(watch(_steps(cases, chosen)), 1):
            answer = contender(case)
            if answer is not None:
                of_case.rows.append(score(case, name, answer))
                of_case.calibration[name] = _calibration(case, answer)
            if number % len(chosen) == 0:
                scores.extend(of_case)
                of_case = Scores()
        scores.interrupted = False
    return scores


def _steps(cases: Iterable[Case], chosen: Mapping[str, Contender]) -> Iterator[Step]:
    for case in cases:
        for name, contender in chosen.items():
            yield case, name, contender


def _calibration(case: Case, answer: Answer) -> CalibrationBins:
    assert answer.outlier_score is not None
    decided = case.is_false | case.is_good
    bins = CalibrationBins()
    bins.add(answer.outlier_score[decided], case.is_false[decided])
    return bins


def geometric_mean(values: Iterable[float]) -> float:
    """Geometric mean; NaN if there are no values."""
    collected = list(values)
    return float(gmean(collected)) if collected else float("nan")
