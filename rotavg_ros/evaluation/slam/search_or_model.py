"""Why answers of the posterior are wrong: the search missed a likelier one, or the model prefers a wrong one."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.diagnosis import compare_with_truth

# An answer is wrong if its error exceeds that of the one found from the truth by this factor and angle.
_FACTOR, _ANGLE_DEG = 1.1, 0.3
# Labellings whose F differs by less, in nats, are rivals.
_RIVAL_NATS = 5.0
RIGHT, SEARCH, MODEL, DIVIDED = "right", "search", "model", "divided"


@dataclass(frozen=True)
class Diagnosis:
    """The diagnosis of one case.

    Attributes:
        case: the case's key.
        error_deg: error of the published answer.
        truth_error_deg: error of the posterior's answer when started from the true labels and orientations.
        rise: F of the found answer minus F from the truth, nats.
        terms: the rise of each term of F.
    """

    case: CaseKey
    error_deg: float
    truth_error_deg: float
    rise: float
    terms: dict[str, float]

    @property
    def cause(self) -> str:
        """``right``, or why it is wrong: ``search``, ``model``, or ``divided`` between rivals."""
        if self.error_deg <= _FACTOR * self.truth_error_deg + _ANGLE_DEG:
            return RIGHT
        if abs(self.rise) <= _RIVAL_NATS:
            return DIVIDED
        return SEARCH if self.rise > 0 else MODEL


def diagnose(case: Case) -> Diagnosis:
    """Solve a case, of which all is known, as usual and from the truth."""
    comparison = compare_with_truth(case.graph, case.truth, ~case.is_inlier)
    component = case.graph.components()
    found, from_truth = (
        float(np.degrees(orientation_errors(orientations, case.truth, component).numpy().mean()))
        for orientations in (comparison.found, comparison.from_truth)
    )
    return Diagnosis(case.key, found, from_truth, comparison.rise, comparison.terms)


def shares(title: str, diagnoses: Sequence[Diagnosis]) -> Table:
    """Of every kind and of all, how many answers are wrong and why."""
    rows = [_row("all", diagnoses)]
    for kind in dict.fromkeys(diagnosis.case.kind for diagnosis in diagnoses):
        rows.append(_row(kind, [diagnosis for diagnosis in diagnoses if diagnosis.case.kind == kind]))
    columns = (
        Column("kind"),
        Column("drawings", "d"),
        *(Column(f"{cause} %", ".1f") for cause in (RIGHT, SEARCH, MODEL, DIVIDED)),
    )
    note = (
        f"Wrong: an error above {_FACTOR:g} times that from the true labels and orientations and {_ANGLE_DEG:g}°. "
        f"Search: F is more than {_RIVAL_NATS:g} nats above that from the truth; model: more than that below; divided: "
        "between."
    )
    return Table(title, columns, tuple(rows), (note,))


def failures(title: str, diagnoses: Iterable[Diagnosis]) -> Table:
    """Every wrong answer that is not divided, and the terms of F that change most."""
    wrong = [diagnosis for diagnosis in diagnoses if diagnosis.cause in (SEARCH, MODEL)]
    rows: list[tuple[Cell, ...]] = []
    for diagnosis in sorted(wrong, key=lambda diagnosis: -abs(diagnosis.rise)):
        largest = sorted(diagnosis.terms.items(), key=lambda term: -abs(term[1]))[:3]
        told = ", ".join(f"{name} {nats:+.0f}" for name, nats in largest)
        errors = diagnosis.error_deg, diagnosis.truth_error_deg
        rows.append((str(diagnosis.case), diagnosis.cause, *errors, diagnosis.rise, told))
    columns = (
        Column("case"),
        Column("cause"),
        Column("error °", ".2f"),
        Column("from the truth °", ".2f"),
        Column("F, nats", "+.1f"),
        Column("of it"),
    )
    return Table(title, columns, tuple(rows))


def _row(name: str, diagnoses: Sequence[Diagnosis]) -> tuple[Cell, ...]:
    causes = [diagnosis.cause for diagnosis in diagnoses]
    return (
        name,
        len(causes),
        *(100 * causes.count(cause) / max(len(causes), 1) for cause in (RIGHT, SEARCH, MODEL, DIVIDED)),
    )
