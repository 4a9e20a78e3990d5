"""The SLAM suite's report: tables and pictures of batch solves, of incremental runs and of the stated uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rotavg_ros.evaluation.common.score_tables import (
    VERDICT_FIGURES,
    Figure,
    good_flagged,
    per_case,
    precision_and_recall,
)
from rotavg_ros.evaluation.common.scoring import Scores, geometric_mean
from rotavg_ros.evaluation.common.tables import Cell, Column, Report, Table
from rotavg_ros.evaluation.live import incremental_plot
from rotavg_ros.evaluation.live import tables as live_tables
from rotavg_ros.evaluation.live.incremental import IncrementalRun
from rotavg_ros.evaluation.slam import plots, uncertainty
from rotavg_ros.evaluation.slam.cases import AS_RECORDED
from rotavg_ros.evaluation.slam.contenders import GNC, ORACLE, OURS, ROWS
from rotavg_ros.evaluation.slam.uncertainty import UncertaintyCheck
from rotavg_ros.solver.methods import without

_KITTI = "KITTI"
_NUM_WORST = 12
# Whose verdicts on closures are told: those that give some.
_JUDGES = (OURS, without("cleannet"), GNC)
_CASE_KEY = {"graph": "name", "condition": "kind", "seed": "seed"}
_CASE_FIGURES = (
    Figure("mean_deg", "error_deg"),
    *VERDICT_FIGURES,
)


def report(
    folder: Path,
    scores: Scores,
    incremental: Sequence[IncrementalRun],
    checks: Sequence[UncertaintyCheck],
    command: str,
) -> Path:
    """Write tables and pictures; returns the Markdown file.

    Args:
        command: how to get the same figures again.
    """
    names = scores.contenders
    recorded = scores.where(OURS, kind=AS_RECORDED).names
    kitti = tuple(name for name in scores.names if name.startswith(_KITTI))
    classic = tuple(name for name in scores.names if name not in (*recorded, *kitti))
    tables: dict[str, Table] = {}
    pictures: dict[str, str] = {}
    for stem, title, graphs in (
        ("slam-ratios", "Classic pose graphs: error over the oracle's", classic),
        ("slam-ratios-kitti", "KITTI, monocular visual odometry: error over the oracle's", kitti),
    ):
        if graphs:
            tables[stem] = _ratios(title, scores.where(names=graphs), names)
            picture = f"{stem}.png"
            labels = {name: ROWS.get(name, name) for name in names}
            plots.ratios(folder / picture, scores.where(names=graphs), labels, title)
            pictures[picture] = f"{title}, geometric mean over graphs and seeds, against the share of false closures."
    if recorded:
        tables["slam-recorded"] = _recorded("Real closures as recorded, against ground truth", scores, names, recorded)
    if classic or kitti:
        spoiled = (*classic, *kitti)
        tables["slam-verdicts"] = _verdicts("Verdicts on loop closures", scores, names, spoiled)
        tables["slam-worst"] = _worst("Where it is worst", scores, spoiled)
    tables["slam-seconds"] = _seconds("CPU seconds for a whole graph", scores, names)
    if incremental:
        tables["slam-incremental"] = live_tables.incremental("Incremental", incremental)
        for run in incremental:
            picture = f"slam-incremental-{run.case.key.name}.png"
            incremental_plot.draw(folder / picture, run)
            pictures[picture] = f"{run.case.key}: mean error of all keyframes so far, tick by tick."
    if checks:
        tables["slam-uncertainty"] = uncertainty.table("Stated uncertainty", checks)
    introduction = (
        f"`{command}`. Error: mean angle between estimated and true orientations after one robust global rotation. "
        "Where a graph has no ground truth, its clean least-squares solution stands in for it. The oracle is least "
        "squares, with the stated precisions, on the rotations of edges that are known to be good; on B25b ours uses "
        "translations, too. Errors below 0.1° (0.3° without ground truth) count as that much. A closure is false if "
        "its noise exceeds 10°; those between 8° and 12° do not count in verdicts, nor do random ones that happen to "
        "fit."
    )
    cases = {"slam-cases": per_case("Every case", scores, _CASE_FIGURES, _CASE_KEY)}
    return Report("slam", "SLAM pose graphs", introduction, tables, pictures, cases).write(folder)


def _ratios(title: str, scores: Scores, names: Sequence[str]) -> Table:
    ours = scores.where(OURS)
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        cells: list[Cell] = [ROWS.get(name, name)]
        for kind in ours.kinds:
            ratios = scores.ratios(name, ORACLE, "floored_deg", kind).values()
            cells += [geometric_mean(ratios), max(ratios, default=float("nan"))]
        rows.append(tuple(cells))
    columns = [Column("method")]
    for kind in ours.kinds:
        columns += [Column(kind, ".2f"), Column("worst", ".1f")]
    notes = [f"Geometric mean and worst case over: {', '.join(scores.names)}."]
    for kind in ours.kinds:
        present = ours.where(kind=kind).names
        absent = [name for name in scores.names if name not in present]
        if absent:
            notes.append(f"{kind}: without {', '.join(absent)}, which have no place that qualifies.")
    total = len(ours.rows)
    gave_up = [f"{ROWS.get(name, name)}: {total - len(scores.where(name).rows)}" for name in names]
    gave_up = [text for text in gave_up if not text.endswith(": 0")]
    if gave_up:
        notes.append(f"Of {total} cases these gave up some, which do not count against them: {'; '.join(gave_up)}.")
    return Table(title, tuple(columns), tuple(rows), tuple(notes))


def _recorded(title: str, scores: Scores, names: Sequence[str], graphs: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for graph in graphs:
        for name in names:
            for row in scores.where(name, [graph]).rows:
                counts = row.counts
                rows.append(
                    (
                        graph,
                        row.case.kind,
                        ROWS.get(name, name),
                        row.mean_deg,
                        *precision_and_recall(counts),
                        _percent(good_flagged(counts)),
                        row.cpu_seconds,
                    )
                )
    columns = (
        Column("graph"),
        Column("condition"),
        Column("method"),
        Column("mean °", ".2f"),
        Column("precision", ".3f"),
        Column("recall", ".3f"),
        Column("good flagged %", ".2f"),
        Column("CPU s", ".3f"),
    )
    note = (
        "Methods that give no verdicts are judged by their residuals: a closure with more than 10° is called false. "
        "Precision and recall are empty where none is."
    )
    oracle = (
        "The oracle does without closures whose truth is unknown, be they good or false: where some of these matter, "
        "others are better."
    )
    return Table(title, columns, tuple(rows), (note, oracle))


def _verdicts(title: str, scores: Scores, names: Sequence[str], graphs: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in (name for name in _JUDGES if name in names):
        for condition in scores.where(name, graphs).kinds:
            of_condition = scores.where(name, graphs, condition)
            counts = of_condition.counts()
            worst = max(of_condition.rows, key=lambda row: row.counts.false_alarm_rate)
            rows.append(
                (
                    ROWS.get(name, name),
                    condition,
                    *precision_and_recall(counts),
                    _percent(good_flagged(counts)),
                    _percent(good_flagged(worst.counts)),
                    worst.case.name,
                )
            )
    columns = (
        Column("method"),
        Column("condition"),
        Column("precision", ".4f"),
        Column("recall", ".4f"),
        Column("good flagged %", ".2f"),
        Column("worst %", ".2f"),
        Column("of"),
    )
    return Table(title, columns, tuple(rows), ("Over all closures of all graphs and seeds.",))


def _percent(share: float | None) -> Cell:
    return None if share is None else 100 * share


def _worst(title: str, scores: Scores, graphs: Sequence[str]) -> Table:
    of_graphs = scores.where(names=graphs)
    ratios = of_graphs.ratios(OURS, ORACLE, "floored_deg")
    ours, oracle = of_graphs.of(OURS), of_graphs.of(ORACLE)
    worst = sorted(ratios, key=lambda case: -ratios[case])[:_NUM_WORST]
    rows: list[tuple[Cell, ...]] = [
        (
            str(case),
            ratios[case],
            ours[case].mean_deg,
            oracle[case].mean_deg,
            ours[case].counts.false_negatives,
            ours[case].counts.false_positives,
        )
        for case in worst
    ]
    columns = (
        Column("case"),
        Column("ratio", ".2f"),
        Column("ours °", ".2f"),
        Column("oracle °", ".2f"),
        Column("false not flagged", "d"),
        Column("good flagged", "d"),
    )
    return Table(title, columns, tuple(rows))


def _seconds(title: str, scores: Scores, names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for graph in scores.names:
        of_graph = scores.where(names=[graph])
        speed_up = of_graph.ratios(GNC, OURS, "cpu_seconds").values()
        seconds = [of_graph.mean(name, "cpu_seconds") for name in names]
        rows.append((graph, *seconds, geometric_mean(speed_up), min(speed_up, default=float("nan"))))
    columns = (
        Column("graph"),
        *(Column(ROWS.get(name, name), ".3f") for name in names),
        Column("GNC ÷ ours", ".0f"),
        Column("least", ".0f"),
    )
    note = "Means over conditions and seeds; the speed ratio is the geometric mean over cases, and the least of them."
    return Table(title, columns, tuple(rows), (note,))
