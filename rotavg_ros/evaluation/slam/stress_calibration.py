"""A contender's statements about its answers on the stress suite against the truth: probabilities and uncertainty."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass, field
from typing import Any, Generic, Protocol, TypeVar

import numpy as np

from rotavg_ros.datasets.simulation.stress.kinds import ONE_PAIR
from rotavg_ros.evaluation.common.answers import Answer
from rotavg_ros.evaluation.common.cases import Case, CaseKey
from rotavg_ros.evaluation.common.contenders import Contender
from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.evaluation.slam.uncertainty import normalized_errors
from rotavg_ros.metrics import CalibrationBins

# Scores outside this range are certain; they are so numerous that they would hide the calibration of the others.
UNSURE = (0.05, 0.95)
# A rotation whose roll and pitch are smaller is one about the vertical.
_FLAT = 1e-9


@dataclass
class Statements:
    """What one answer states, or several together.

    Attributes:
        unsure: probabilities of edges between :data:`UNSURE`, and whether the edges are false.
        num_unsure, num_judged: such edges, and all clearly good and false ones.
        num_errors, within_one, within_two: errors that an uncertainty is stated for, and those within one and two
            standard deviations.
    """

    unsure: CalibrationBins = field(default_factory=CalibrationBins)
    num_unsure: int = 0
    num_judged: int = 0
    num_errors: int = 0
    within_one: int = 0
    within_two: int = 0

    def extend(self, other: Statements) -> None:
        """Take in what another has counted."""
        self.unsure.extend(other.unsure)
        self.num_unsure += other.num_unsure
        self.num_judged += other.num_judged
        self.num_errors += other.num_errors
        self.within_one += other.within_one
        self.within_two += other.within_two


class _Counted(Protocol):
    def extend(self, other: Any) -> None:
        """Take in what another has counted."""


CountedT = TypeVar("CountedT", bound=_Counted)


class Watcher(Generic[CountedT]):
    """Looks over a contender's shoulder, and counts something of its answers, case by case.

    Args:
        nothing: makes what has counted nothing yet.
        look: what an answer to a case counts for; None: not at all.
    """

    def __init__(self, nothing: Callable[[], CountedT], look: Callable[[Case, Answer], CountedT | None]) -> None:
        self._nothing, self._look = nothing, look
        self._of_case: dict[CaseKey, CountedT] = {}

    def watching(self, contender: Contender) -> Contender:
        """The same contender, whose answers are counted."""

        def watched(case: Case) -> Answer | None:
            answer = contender(case)
            if answer is not None and (found := self._look(case, answer)) is not None:
                self._of_case[case.key] = found
            return answer

        return watched

    def of_kinds(self, cases: Collection[CaseKey]) -> dict[str, CountedT]:
        """By kind, of these cases."""
        found: dict[str, CountedT] = {}
        for key in cases:
            if key in self._of_case:
                found.setdefault(key.kind, self._nothing()).extend(self._of_case[key])
        return found


class Calibration(Watcher[Statements]):
    """Counts what every answer states."""

    def __init__(self) -> None:
        super().__init__(Statements, statements)


def statements(case: Case, answer: Answer) -> Statements:
    """What an answer states of a case."""
    found = Statements()
    if answer.outlier_score is not None:
        decided = case.is_false | case.is_good
        unsure = decided & (answer.outlier_score >= UNSURE[0]) & (answer.outlier_score <= UNSURE[1])
        found.unsure.add(answer.outlier_score[unsure], case.is_false[unsure])
        found.num_unsure, found.num_judged = int(unsure.sum()), int(decided.sum())
    if answer.uncertainty is not None:
        components = 1 if float(case.truth[:, :2].abs().max()) < _FLAT else 3
        found_by = (answer.body_from_world, case.graph.components(), answer.uncertainty)
        values = np.abs(normalized_errors(*found_by, case.truth, components))
        values = values[np.isfinite(values)]  # nodes without a stated uncertainty do not count
        found.num_errors = len(values)
        found.within_one, found.within_two = int((values < 1).sum()), int((values < 2).sum())
    return found


def table(title: str, of_kinds: dict[str, Statements], every_kind: bool) -> Table:
    """All kinds together, those of which the truth can be known, and with ``every_kind`` each by itself."""
    rows: list[tuple[Cell, ...]] = [_row("all", _together(of_kinds.values()))]
    # What may as well be false closures is no slip that a score could tell of (same_data.py).
    known = {kind: found for kind, found in of_kinds.items() if ONE_PAIR not in kind}
    if len(known) < len(of_kinds):
        rows.append(_row(f"all but those of {ONE_PAIR}", _together(known.values())))
    if every_kind:
        rows += [_row(kind, found) for kind, found in of_kinds.items()]
    columns = (
        Column("kind"),
        Column("edges judged", "d"),
        Column("of them unsure", "d"),
        Column("ECE of those", ".3f"),
        Column("within 1σ", ".3f"),
        Column("within 2σ", ".3f"),
    )
    low, high = UNSURE
    note = (
        f"Unsure: scores of {low:g}–{high:g}. ECE: mean distance of stated probability and observed share. Errors are "
        "relative to the first node of their component; 0.683 and 0.954 would be right."
    )
    return Table(title, columns, tuple(rows), (note,))


def _together(found: Iterable[Statements]) -> Statements:
    total = Statements()
    for each in found:
        total.extend(each)
    return total


def _row(name: str, found: Statements) -> tuple[Cell, ...]:
    error = found.unsure.error if found.num_unsure else None
    shares = [count / found.num_errors if found.num_errors else None for count in (found.within_one, found.within_two)]
    return (name, found.num_judged, found.num_unsure, error, *shares)
