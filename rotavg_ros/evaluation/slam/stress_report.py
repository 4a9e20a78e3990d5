"""The stress suite's report: errors over the oracle's by kind and in all, and where a peer is better than ours."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from rotavg_ros.evaluation.common.score_tables import VERDICT_FIGURES, Figure, per_case, precision_and_recall
from rotavg_ros.evaluation.common.scoring import Scores, geometric_mean
from rotavg_ros.evaluation.common.tables import Cell, Column, Report, Table
from rotavg_ros.evaluation.slam import same_data, search_or_model, sensitivity, stress_calibration
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS, ROSTER, ROWS
from rotavg_ros.evaluation.slam.same_data import SameData
from rotavg_ros.evaluation.slam.search_or_model import Diagnosis
from rotavg_ros.evaluation.slam.stress_calibration import Calibration

_FIGURE = "floored_deg"
_LARGE, _VERY_LARGE = 2.0, 5.0
# A peer is better where its error is smaller by at least this factor, and by more than this many standard errors.
_BETTER, _STANDARD_ERRORS = 1.05, 2.0
# Of fewer common cases there is no standard error.
_LEAST_CASES = 2
# Who counts as a peer: independent methods, none of which is told what only an oracle knows.
_PEERS = (*ROSTER.peers, "chatterjee")
_NUM_WORST = 20
_CASE_KEY = {"kind": "kind", "seed": "seed"}
_CASE_FIGURES = (
    Figure("mean_deg", "mean_deg"),
    Figure(_FIGURE, _FIGURE),
    *VERDICT_FIGURES,
)


@dataclass(frozen=True)
class Rival:
    """A peer on a kind on which it is better than a contender.

    Attributes:
        ratio: geometric mean of its error over the contender's, below one.
        standard_error: of that mean's logarithm.
    """

    kind: str
    peer: str
    ratio: float
    standard_error: float
    num_cases: int


@dataclass(frozen=True)
class Findings:
    """What was looked at besides errors.

    Attributes:
        calibration: of ours.
        same_data: of ours, likewise, of lone slips that may be false closures.
        diagnoses: of the posterior's answers.
        priors: answers under other priors, of every case.
    """

    calibration: Calibration
    same_data: SameData = field(default_factory=SameData)
    diagnoses: Sequence[Diagnosis] = ()
    priors: Sequence[Sequence[sensitivity.Answer]] = ()


def report(
    folder: Path,
    scores: Scores,
    findings: Findings,
    command: str,
) -> Path:
    """Write the tables; returns the Markdown file.

    Args:
        findings: what was looked at besides errors.
        command: how to get the same figures again.
    """
    names = scores.contenders
    tables = {
        "stress-totals": _totals(scores, names),
        "stress-means": _means(scores, names),
        "stress-better": _better(scores),
        "stress-worst": _worst(scores),
    }
    long = {
        "stress-kinds": _kinds(scores, names),
        "stress-cases": per_case("Every case", scores, _CASE_FIGURES, _CASE_KEY),
    }
    of_kinds, title = findings.calibration.of_kinds(scores.cases), f"Calibration of {ROWS[OURS].replace('**', '')}"
    tables["stress-calibration"] = stress_calibration.table(title, of_kinds, every_kind=False)
    long["stress-calibration-kinds"] = stress_calibration.table(title, of_kinds, every_kind=True)
    if either := findings.same_data.of_kinds(scores.cases):
        tables["stress-same-data"] = same_data.table("A slip, or false closures: the same data", either)
    if diagnoses := findings.diagnoses:
        tables["stress-causes"] = search_or_model.shares("Why the posterior's answers are wrong", diagnoses)
        tables["stress-failures"] = search_or_model.failures("Wrong answers that are not divided", diagnoses)
    if findings.priors:
        tables["stress-priors"] = sensitivity.table("Priors of the posterior halved and doubled", findings.priors)
    introduction = (
        f"`{command}`. Simulated pose graphs that are hard in one known way each. Error: mean angle between estimated "
        "and true orientations after one robust global rotation of each component; below 0.1° it counts as 0.1°. The "
        "oracle is least squares on the rotations of edges that are good, with their true variances. A closure is "
        "false if its noise exceeds 10°; those between 8° and 12° do not count in verdicts."
    )
    return Report("stress", "Stress suite", introduction, tables, extra_csv=long).write(folder)


def rivals(scores: Scores, name: str) -> Iterator[Rival]:
    """On every kind of at least two common cases the peer that beats the contender by most, if any does."""
    peers = [peer for peer in _peers(scores) if peer != name]
    for kind in scores.kinds:
        of_kind = [rival for peer in peers if (rival := _rival(scores, kind, peer, name)) is not None]
        if of_kind:
            yield min(of_kind, key=lambda rival: rival.ratio)


def _peers(scores: Scores) -> list[str]:
    """Those that took part."""
    return [peer for peer in _PEERS if peer in scores.contenders]


def _rival(scores: Scores, kind: str, peer: str, name: str) -> Rival | None:
    """The peer as a rival; None if it is not significantly better."""
    logarithms = np.log(list(scores.ratios(peer, name, _FIGURE, kind).values()))
    if len(logarithms) < _LEAST_CASES:
        return None
    mean, error = float(logarithms.mean()), float(logarithms.std(ddof=1) / np.sqrt(len(logarithms)))
    is_better = -mean > np.log(_BETTER) and -mean > _STANDARD_ERRORS * error
    return Rival(kind, peer, float(np.exp(mean)), error, len(logarithms)) if is_better else None


def _totals(scores: Scores, names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        ratios = np.array(list(scores.ratios(name, ORACLE, _FIGURE).values()))
        counts = scores.where(name).counts()
        rows.append(
            (
                ROWS.get(name, name),
                len(ratios),
                float(np.log(ratios).mean()) if len(ratios) else None,
                geometric_mean(ratios),
                *_tail(ratios),
                None if name == ORACLE else _share_lost(scores, name),
                *precision_and_recall(counts),
                scores.mean(name, "cpu_seconds"),
            )
        )
    columns = (
        Column("method"),
        Column("cases", "d"),
        Column("mean log ratio", ".3f"),
        Column("geometric mean", ".2f"),
        Column(f"share over {_LARGE:g}×", ".3f"),
        Column(f"over {_VERY_LARGE:g}×", ".3f"),
        Column("kinds where a peer is better", ".3f"),
        Column("precision", ".4f"),
        Column("recall", ".4f"),
        Column("CPU s", ".3f"),
    )
    notes = (
        "Ratios are errors over the oracle's, case by case. Precision and recall are empty where no closure is false.",
        f"A peer is better on a kind where the geometric mean of its error over the method's is {1 / _BETTER:.3f} or "
        f"less, and lies more than {_STANDARD_ERRORS:g} standard errors below one. Peers: "
        f"{', '.join(_peers(scores)) or 'none'}.",
        "Kinds without two common cases cannot tell; where none can, the share is empty.",
        "Cases that a method gave up, or that are too large for it, do not count against it.",
    )
    return Table("All kinds", columns, tuple(rows), notes)


def _share_lost(scores: Scores, name: str) -> float | None:
    """Share of the kinds on which a peer is better, among those where that can be told; None: on none."""
    peers = [peer for peer in _peers(scores) if peer != name]
    compared = (
        max((len(scores.ratios(peer, name, _FIGURE, kind)) for peer in peers), default=0) for kind in scores.kinds
    )
    can_be_told = sum(cases >= _LEAST_CASES for cases in compared)
    return len([*rivals(scores, name)]) / can_be_told if can_be_told else None


def _means(scores: Scores, names: Sequence[str]) -> Table:
    shown = [name for name in names if name != ORACLE]
    rows: list[tuple[Cell, ...]] = []
    for kind in scores.kinds:
        oracle = scores.where(ORACLE, kind=kind).mean(ORACLE, "mean_deg")
        means = (geometric_mean(scores.ratios(name, ORACLE, _FIGURE, kind).values()) for name in shown)
        rows.append((kind, oracle, *means))
    columns = (Column("kind"), Column("oracle °", ".2f"), *(Column(ROWS.get(name, name), ".2f") for name in shown))
    return Table("Every kind: geometric mean of error over the oracle's", columns, tuple(rows))


def _kinds(scores: Scores, names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for kind in scores.kinds:
        for name in names:
            ratios = np.array(list(scores.ratios(name, ORACLE, _FIGURE, kind).values()))
            if len(ratios):
                high = float(np.quantile(ratios, 0.9))
                row = (kind, name, len(ratios), geometric_mean(ratios), high, float(ratios.max()))
                rows.append((*row, *_tail(ratios)))
    headings = ("kind", "method", "cases", "geometric_mean", "p90", "worst", "share_over_2", "share_over_5")
    return Table("Every kind", tuple(map(Column, headings)), tuple(rows))


def _tail(ratios: np.ndarray) -> tuple[Cell, Cell]:
    if len(ratios) == 0:
        return None, None
    return float((ratios > _LARGE).mean()), float((ratios > _VERY_LARGE).mean())


def _better(scores: Scores) -> Table:
    found = sorted(rivals(scores, OURS), key=lambda rival: rival.ratio)
    rows = tuple(
        (rival.kind, ROWS.get(rival.peer, rival.peer), rival.ratio, rival.standard_error, rival.num_cases)
        for rival in found
    )
    columns = (
        Column("kind"),
        Column("peer"),
        Column("its error over ours", ".2f"),
        Column("standard error of the logarithm", ".2f"),
        Column("cases", "d"),
    )
    return Table("Where a peer is better than ours", columns, rows)


def _worst(scores: Scores) -> Table:
    ratios = scores.ratios(OURS, ORACLE, _FIGURE)
    ours, oracle = scores.of(OURS), scores.of(ORACLE)
    rows = tuple(
        (
            case.kind,
            case.seed,
            ratios[case],
            ours[case].mean_deg,
            oracle[case].mean_deg,
            ours[case].counts.false_negatives,
            ours[case].counts.false_positives,
        )
        for case in sorted(ratios, key=lambda case: -ratios[case])[:_NUM_WORST]
    )
    columns = (
        Column("kind"),
        Column("seed", "d"),
        Column("ratio", ".2f"),
        Column("ours °", ".2f"),
        Column("oracle °", ".2f"),
        Column("false not flagged", "d"),
        Column("good flagged", "d"),
    )
    return Table("Where it is worst", columns, rows)
