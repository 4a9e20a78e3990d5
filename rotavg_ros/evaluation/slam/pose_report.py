"""The report of the suite of poses: errors of positions over the oracle's, verdicts by place, what each was told."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path

import numpy as np

from rotavg_ros.evaluation.common.score_tables import (
    VERDICT_FIGURES,
    Figure,
    good_flagged,
    per_case,
    precision_and_recall,
)
from rotavg_ros.evaluation.common.scoring import Scores, geometric_mean
from rotavg_ros.evaluation.common.tables import Cell, Column, Report, Table
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS
from rotavg_ros.evaluation.slam.pose_cases import AS_RECORDED, JUMPS, RECORDED_NOISE
from rotavg_ros.evaluation.slam.pose_contenders import PEERS, ROWS, TOLD
from rotavg_ros.metrics import OutlierCounts

_METRES, _DEGREES = "floored_m", "floored_deg"
_LARGE, _VERY_LARGE = 2.0, 5.0
# A peer is better where its error is smaller by this factor at least.
_BETTER = 1.05
_NUM_WORST = 15
_NONE_FALSE = (
    "Where no closure is false, the share of good closures that are not flagged stands in place of the precision."
)
_CASE_KEY = {"graph": "name", "condition": "kind", "seed": "seed"}
_CASE_FIGURES = (
    Figure("ate_m", "ate_m"),
    Figure("mean_deg", "mean_deg"),
    *VERDICT_FIGURES,
)


def report(folder: Path, scores: Scores, command: str) -> Path:
    """Write the tables; returns the Markdown file.

    Args:
        command: how to get the same figures again.
    """
    drawn = Scores([row for row in scores.rows if row.case.kind != AS_RECORDED])
    recorded = scores.where(kind=AS_RECORDED)
    tables: dict[str, Table] = {}
    if drawn.rows:
        tables["poses-totals"] = _totals("All drawings", drawn)
        sound = Scores([row for row in drawn.rows if row.case.kind != JUMPS])
        if 0 < len(sound.rows) < len(drawn.rows):
            tables["poses-sound"] = _totals("Drawings whose odometry is right, as peers are told", sound)
        tables["poses-positions"] = _by("Positions: geometric mean of ATE over the oracle's", drawn, _METRES, "kind")
        tables["poses-orientations"] = _by(
            "Orientations: geometric mean of the mean error over the oracle's", drawn, _DEGREES, "kind"
        )
        tables["poses-verdicts"] = _verdicts(drawn)
        tables["poses-graphs"] = _by("Positions, graph by graph: the same", drawn, _METRES, "name")
    if recorded.rows:
        tables["poses-recorded"] = _recorded(recorded)
    if scores.rows:
        tables["poses-better"] = _better(scores)
        tables["poses-worst"] = _worst(scores)
    tables["poses-told"] = _told(scores.contenders)
    seeds = ", ".join(map(str, dict.fromkeys(case.seed for case in drawn.cases)))
    drawings = f"{len(drawn.cases)} drawings (seeds {seeds})" if drawn.rows else "No drawings"
    introduction = (
        f"`{command}`. {drawings} of graphs whose true poses are known, since every edge is drawn from them, and "
        f"{len(recorded.cases)} recorded graphs with ground truth. ATE: root mean square distance of positions to the "
        "true ones after rigid alignment without scale; below 0.05 m it counts as 0.05 m. Orientations: mean angle "
        "after one robust global rotation; below 0.1° it counts as 0.1°. A closure is false if its rotation errs by "
        "more than 10° or its translation by more than 2 m; those between 8° and 12°, or 1.5 m and 4 m, do not count "
        "in verdicts, unless the other clearly errs. Who gives no verdicts is judged by what its answer leaves: more "
        "than 10° or 2 m. The oracle knows which closures are good and what all edges err by."
    )
    cases = {"poses-cases": per_case("Every case", scores, _CASE_FIGURES, _CASE_KEY)}
    return Report(
        "poses", "Positions and closures that join wrong places", introduction, tables, extra_csv=cases
    ).write(folder)


def _totals(title: str, scores: Scores) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in scores.contenders:
        ratios = np.array([*scores.ratios(name, ORACLE, _METRES).values()])
        ratios = ratios[np.isfinite(ratios)]
        counts = scores.where(name).counts()
        rows.append(
            (
                ROWS.get(name, name),
                len(scores.of(name)),
                geometric_mean(ratios),
                float((ratios > _LARGE).mean()) if len(ratios) else None,
                float((ratios > _VERY_LARGE).mean()) if len(ratios) else None,
                geometric_mean(scores.ratios(name, ORACLE, _DEGREES).values()),
                *_judged(counts),
                scores.mean(name, "cpu_seconds"),
            )
        )
    columns = (
        Column("method"),
        Column("cases", "d"),
        Column("ATE ratio", ".2f"),
        Column(f"share over {_LARGE:g}×", ".3f"),
        Column(f"over {_VERY_LARGE:g}×", ".3f"),
        Column("orientation ratio", ".2f"),
        Column("precision", ".4f"),
        Column("recall", ".4f"),
        Column("CPU s", ".2f"),
    )
    notes = (
        "Ratios are errors over the oracle's, geometric means. Precision and recall are of all closures together. "
        f"{_NONE_FALSE}",
        "Closures of right rotation that join wrong places still tell rotations, and the oracle does without them: "
        "ratios may lie below one.",
        "Cases that a method gave up, or that are too large for it, do not count against it.",
        *((f"Under {JUMPS!r} odometry is not right, as peers are told.",) if JUMPS in scores.kinds else ()),
    )
    return Table(title, columns, tuple(rows), notes)


def _by(title: str, scores: Scores, figure: str, key: str) -> Table:
    """A row per contender, a column per condition or graph, with the oracle's own mean in the last row."""
    groups = _groups(scores, key)
    rows: list[tuple[Cell, ...]] = []
    for name in scores.contenders:
        ratios = scores.ratios(name, ORACLE, figure)
        cells: list[Cell] = [ROWS.get(name, name)]
        for group in groups:
            values = [ratio for case, ratio in ratios.items() if getattr(case, key) == group and np.isfinite(ratio)]
            cells += [geometric_mean(values), max(values, default=float("nan"))]
        rows.append(tuple(cells))
    columns = [Column("method")]
    for group in groups:
        columns += [Column(group, ".2f"), Column("worst", ".1f")]
    unit = "m" if figure == _METRES else "°"
    oracle = scores.where(ORACLE).rows
    means = (
        f"{group} {np.mean([row.figure(figure) for row in oracle if getattr(row.case, key) == group]):.2f} {unit}"
        for group in groups
    )
    notes = (f"The oracle's own mean: {'; '.join(means)}.",) if oracle else ()
    return Table(title, tuple(columns), tuple(rows), notes)


def _groups(scores: Scores, key: str) -> tuple[str, ...]:
    return tuple(dict.fromkeys(getattr(case, key) for case in scores.cases))


def _verdicts(scores: Scores) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in scores.contenders:
        cells: list[Cell] = [ROWS.get(name, name)]
        for kind in scores.kinds:
            cells += _judged(scores.where(name, kind=kind).counts())
        rows.append(tuple(cells))
    columns = [Column("method")]
    for kind in scores.kinds:
        columns += [Column(f"{kind}: P", ".3f"), Column("R", ".3f")]
    return Table("Verdicts on closures: precision and recall", tuple(columns), tuple(rows), (_NONE_FALSE,))


def _judged(counts: OutlierCounts) -> tuple[Cell, Cell]:
    """Precision and recall, see :data:`_NONE_FALSE`."""
    if counts.num_outliers:
        return precision_and_recall(counts)
    flagged = good_flagged(counts)
    return None if flagged is None else 1 - flagged, None


def _recorded(scores: Scores) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            row.case.name,
            ROWS.get(row.contender, row.contender),
            row.ate_m,
            row.mean_deg,
            *_judged(row.counts),
            row.cpu_seconds,
        )
        for row in scores.rows
    ]
    headings = ("ATE m", ".2f"), ("mean °", ".2f"), ("precision", ".3f"), ("recall", ".3f"), ("CPU s", ".2f")
    columns = (Column("graph"), Column("method"), *(Column(heading, form) for heading, form in headings))
    left = (
        f"{name} {noise.step_deg:g}° and {noise.step_m:g} m a step, {noise.closure_deg:g}° and {noise.closure_m:g} m a "
        "good closure"
        for name, noise in RECORDED_NOISE.items()
        if name in scores.names
    )
    note = (
        "Real closures against ground truth. For true deviations stand those that edges leave against it: "
        f"{'; '.join(left)}. The oracle uses the closures that ground truth knows to be good; where it does not know "
        "some that matter, others are better."
    )
    return Table("B25b as recorded", columns, tuple(rows), (note, _NONE_FALSE))


def _better(scores: Scores) -> Table:
    """Per graph and condition the peer that is better than ours by most."""
    found = sorted(_rivals(scores), key=lambda row: float(row[3] or 0))
    columns = (
        Column("graph"),
        Column("condition"),
        Column("peer"),
        Column("its ATE over ours", ".2f"),
        Column("drawings", "d"),
    )
    note = f"Geometric means of {1 / _BETTER:.3f} or less. Peers: {', '.join(_peers(scores)) or 'none'}."
    return Table("Where a peer is better than ours", columns, tuple(found), (note,))


def _peers(scores: Scores) -> list[str]:
    """Those that took part."""
    return [peer for peer in PEERS if peer in scores.contenders]


def _rivals(scores: Scores) -> Iterator[tuple[Cell, ...]]:
    for graph in scores.names:
        for kind in scores.where(names=[graph]).kinds:
            these = scores.where(names=[graph], kind=kind)
            ratios = {peer: [*these.ratios(peer, OURS, _METRES).values()] for peer in _peers(scores)}
            means = {peer: geometric_mean(values) for peer, values in ratios.items() if values}
            if means:
                best = min(means, key=lambda peer: means[peer])
                if means[best] * _BETTER <= 1:
                    yield graph, kind, ROWS.get(best, best), means[best], len(ratios[best])


def _worst(scores: Scores) -> Table:
    ratios = scores.ratios(OURS, ORACLE, _METRES)
    ours, oracle = scores.of(OURS), scores.of(ORACLE)
    rows = tuple(
        (
            case.name,
            case.kind,
            case.seed,
            ratios[case],
            ours[case].ate_m,
            oracle[case].ate_m,
            ours[case].counts.false_negatives,
            ours[case].counts.false_positives,
        )
        for case in sorted(ratios, key=lambda case: -ratios[case])[:_NUM_WORST]
    )
    columns = (
        Column("graph"),
        Column("condition"),
        Column("seed", "d"),
        Column("ratio", ".2f"),
        Column("ours m", ".2f"),
        Column("oracle m", ".2f"),
        Column("false not flagged", "d"),
        Column("good flagged", "d"),
    )
    return Table("Where it is worst", columns, rows)


def _told(names: Iterable[str]) -> Table:
    rows: Sequence[tuple[Cell, ...]] = [(ROWS.get(name, name), TOLD.get(name, "as the default")) for name in names]
    return Table("What each is told", (Column("method"), Column("told")), tuple(rows))
