"""How much the posterior's answers depend on its priors: each one is halved and doubled."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, replace

import numpy as np

from rotavg_ros.evaluation.common.cases import Case
from rotavg_ros.evaluation.common.tables import Column, Table
from rotavg_ros.metrics import orientation_errors
from rotavg_ros.solver.diagnosis import SlamPriors, orientations_under

# For probabilities, the odds are halved and doubled.
_PROBABILITIES = frozenset(
    ("tails", "outlier_share", "near_miss_share", "common_errors", "turn_errors", "stated_share")
)


@dataclass(frozen=True)
class Answer:
    """Of one case under one choice of priors.

    Attributes:
        prior: which one is another than usual; empty if none is.
        factor: by which it, or its odds, was multiplied.
        log_error: of what is published, at least the case's floor; natural logarithm, of radians.
    """

    prior: str
    factor: float
    log_error: float


def changed(name: str, factor: float) -> SlamPriors:
    """Priors of which one, or its odds, is ``factor`` times what it is."""
    priors = SlamPriors()
    value = float(getattr(priors, name))
    if name in _PROBABILITIES:
        odds = factor * value / (1 - value)
        return replace(priors, **{name: odds / (1 + odds)})
    return replace(priors, **{name: factor * value})


def variants() -> Iterator[tuple[str, float, SlamPriors]]:
    """Name, factor and priors: as they are, then each halved and doubled."""
    yield "", 1.0, SlamPriors()
    for name in asdict(SlamPriors()):
        for factor in (0.5, 2.0):
            yield name, factor, changed(name, factor)


def answers(case: Case) -> Iterator[Answer]:
    """Of one case under all variants."""
    component = case.graph.components()
    for name, factor, priors in variants():
        orientations = orientations_under(case.graph, priors)
        error = float(orientation_errors(orientations, case.truth, component).nanmean())
        yield Answer(name, factor, float(np.log(max(error, case.floor))))


def table(title: str, found: Iterable[Sequence[Answer]]) -> Table:
    """By how much the geometric mean of the errors changes, and on how many cases by more than a tenth.

    Args:
        title: of the table.
        found: of every case.
    """
    cases = [{(answer.prior, answer.factor): answer.log_error for answer in case} for case in found]
    rows = []
    for name, value in asdict(SlamPriors()).items():
        change = {
            factor: np.array([errors[name, factor] - errors["", 1.0] for errors in cases]) for factor in (0.5, 2.0)
        }
        moved = (int((np.abs(change[factor]) > np.log(1.1)).sum()) for factor in change)
        means = (100 * float(np.expm1(change[factor].mean())) for factor in change)
        rows.append((name, value, *means, *moved))
    columns = (
        Column("prior"),
        Column("value", "g"),
        Column("halved %", "+.1f"),
        Column("doubled %", "+.1f"),
        Column("cases moved, halved", "d"),
        Column("doubled", "d"),
    )
    note = (
        f"Change of the geometric mean of the error over {len(cases)} cases, and on how many of them it changes by "
        "more than a tenth either way. Of probabilities the odds are halved and doubled."
    )
    return Table(title, columns, tuple(rows), (note,))
