"""The SLAM suite's report: tables and pictures of batch solves, of incremental runs and of the stated uncertainty."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from rotavg_ros.evaluation import slam_live_tables, slam_plots
from rotavg_ros.evaluation.slam_cases import AS_RECORDED
from rotavg_ros.evaluation.slam_contenders import OURS, ROWS
from rotavg_ros.evaluation.slam_incremental import IncrementalRun
from rotavg_ros.evaluation.slam_scoring import REFERENCE, SlamScores, geometric_mean, good_flagged
from rotavg_ros.evaluation.slam_uncertainty import UncertaintyCheck
from rotavg_ros.evaluation.tables import Cell, Column, Table, write_report

_GNC = "gnc"
_KITTI = "KITTI"
_NUM_WORST = 12
# Whose verdicts on closures are told: those that give some.
_JUDGES = (OURS, "neurora-without-cleannet", _GNC)


def report(
    folder: Path,
    scores: SlamScores,
    incremental: Sequence[IncrementalRun],
    uncertainty: Sequence[UncertaintyCheck],
    command: str,
) -> Path:
    """Write tables and pictures; returns the Markdown file.

    Args:
        command: how to get the same figures again.
    """
    names = tuple(dict.fromkeys(row.contender for row in scores.rows))
    recorded = scores.where(OURS, condition=AS_RECORDED).graphs
    kitti = tuple(name for name in scores.graphs if name.startswith(_KITTI))
    classic = tuple(name for name in scores.graphs if name not in (*recorded, *kitti))
    tables: dict[str, Table] = {}
    pictures: dict[str, str] = {}
    for stem, title, graphs in (
        ("slam-ratios", "Classic pose graphs: error over the oracle's", classic),
        ("slam-ratios-kitti", "KITTI, monocular visual odometry: error over the oracle's", kitti),
    ):
        if graphs:
            tables[stem] = _ratios(title, scores, names, graphs)
            picture = f"{stem}.png"
            slam_plots.ratios(folder / picture, scores, {name: ROWS.get(name, name) for name in names}, graphs, title)
            pictures[picture] = f"{title}, geometric mean over graphs and seeds, against the share of false closures."
    if recorded:
        tables["slam-recorded"] = _recorded("Real closures as recorded, against ground truth", scores, names, recorded)
    if classic or kitti:
        spoiled = (*classic, *kitti)
        tables["slam-verdicts"] = _verdicts("Verdicts on loop closures", scores, names, spoiled)
        tables["slam-worst"] = _worst("Where it is worst", scores, spoiled)
    tables["slam-seconds"] = _seconds("CPU seconds for a whole graph", scores, names)
    if incremental:
        tables["slam-incremental"] = slam_live_tables.incremental("Incremental", incremental)
        for run in incremental:
            picture = f"slam-incremental-{run.case.graph_name}.png"
            slam_plots.incremental(folder / picture, run)
            pictures[picture] = f"{run.case.name}: mean error of all keyframes so far, tick by tick."
    if uncertainty:
        tables["slam-uncertainty"] = slam_live_tables.uncertainty("Stated uncertainty", uncertainty)
    return write_report(
        folder,
        "slam",
        "SLAM pose graphs",
        f"`{command}`. Error: mean angle between estimated and true orientations after one robust global rotation. "
        "Where a graph has no ground truth, its clean least-squares solution stands in for it. The oracle is least "
        "squares, with the stated precisions, on the edges that are known to be good. Errors below 0.1° (0.3° without "
        "ground truth) count as that much. A closure is false if its noise exceeds 10°; those between 8° and 12° do "
        "not count in verdicts, nor do random ones that happen to fit.",
        tables,
        pictures,
        extra_csv={"slam-cases": _cases("Every case", scores)},
    )


def _ratios(title: str, scores: SlamScores, names: Sequence[str], graphs: Sequence[str]) -> Table:
    conditions = [c for c in scores.conditions if any(row.condition == c for row in scores.where(OURS, graphs).rows)]
    rows: list[tuple[Cell, ...]] = []
    for name in names:
        cells: list[Cell] = [ROWS.get(name, name)]
        for condition in conditions:
            ratios = scores.ratios(name, graphs, condition)
            cells += [geometric_mean(ratios.values()), max(ratios.values(), default=float("nan"))]
        rows.append(tuple(cells))
    columns = [Column("method")]
    for condition in conditions:
        columns += [Column(condition, ".2f"), Column("worst", ".1f")]
    notes = [f"Geometric mean and worst case over: {', '.join(graphs)}."]
    for condition in conditions:
        absent = sorted(set(graphs) - set(scores.where(OURS, graphs, condition).graphs), key=graphs.index)
        if absent:
            notes.append(f"{condition}: without {', '.join(absent)}, which have no place that qualifies.")
    total = len(scores.where(OURS, graphs).rows)
    gave_up = [f"{ROWS.get(name, name)}: {total - len(scores.where(name, graphs).rows)}" for name in names]
    gave_up = [text for text in gave_up if not text.endswith(": 0")]
    if gave_up:
        notes.append(f"Of {total} cases these gave up some, which do not count against them: {'; '.join(gave_up)}.")
    return Table(title, tuple(columns), tuple(rows), tuple(notes))


def _recorded(title: str, scores: SlamScores, names: Sequence[str], graphs: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for graph in graphs:
        for name in names:
            for row in scores.where(name, [graph]).rows:
                counts = row.counts
                rows.append(
                    (
                        graph,
                        ROWS.get(name, name),
                        row.error_deg,
                        counts.precision,
                        counts.recall,
                        100 * good_flagged(counts),
                        row.cpu_seconds,
                    )
                )
    columns = (
        Column("graph"),
        Column("method"),
        Column("mean °", ".2f"),
        Column("precision", ".3f"),
        Column("recall", ".3f"),
        Column("good flagged %", ".2f"),
        Column("CPU s", ".3f"),
    )
    note = "Methods that give no verdicts are judged by their residuals: a closure with more than 10° is called false."
    return Table(title, columns, tuple(rows), (note,))


def _verdicts(title: str, scores: SlamScores, names: Sequence[str], graphs: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for name in (name for name in _JUDGES if name in names):
        for condition in scores.where(name, graphs).conditions:
            of_condition = scores.where(name, graphs, condition)
            counts = of_condition.counts()
            has_false = counts.true_positives + counts.false_negatives > 0
            worst = max(of_condition.rows, key=lambda row: good_flagged(row.counts))
            rows.append(
                (
                    ROWS.get(name, name),
                    condition,
                    counts.precision if has_false else None,
                    counts.recall if has_false else None,
                    100 * good_flagged(counts),
                    100 * good_flagged(worst.counts),
                    worst.graph_name,
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


def _worst(title: str, scores: SlamScores, graphs: Sequence[str]) -> Table:
    ratios = scores.ratios(OURS, graphs)
    ours = {row.case: row for row in scores.where(OURS).rows}
    oracle = {row.case: row for row in scores.where(REFERENCE).rows}
    worst = sorted(ratios, key=lambda case: -ratios[case])[:_NUM_WORST]
    rows: list[tuple[Cell, ...]] = [
        (
            case,
            ratios[case],
            ours[case].error_deg,
            oracle[case].error_deg,
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


def _seconds(title: str, scores: SlamScores, names: Sequence[str]) -> Table:
    rows: list[tuple[Cell, ...]] = []
    for graph in scores.graphs:
        of_graph = SlamScores(tuple(row for row in scores.rows if row.graph_name == graph))
        pairs = of_graph.speed_ratios(OURS, _GNC).values()
        speed_up = [theirs / ours for ours, theirs in pairs]
        seconds = [of_graph.where(name).mean("cpu_seconds") for name in names]
        rows.append((graph, *seconds, geometric_mean(speed_up), min(speed_up, default=float("nan"))))
    columns = (
        Column("graph"),
        *(Column(ROWS.get(name, name), ".3f") for name in names),
        Column("GNC ÷ ours", ".0f"),
        Column("least", ".0f"),
    )
    note = "Means over conditions and seeds; the speed ratio is the geometric mean over cases, and the least of them."
    return Table(title, columns, tuple(rows), (note,))


def _cases(title: str, scores: SlamScores) -> Table:
    rows: list[tuple[Cell, ...]] = [
        (
            row.graph_name,
            row.condition,
            row.seed,
            row.contender,
            row.error_deg,
            row.counts.true_positives,
            row.counts.false_positives,
            row.counts.false_negatives,
            row.counts.true_negatives,
            row.odometry_flagged,
            row.cpu_seconds,
        )
        for row in scores.rows
    ]
    headings = (
        "graph condition seed method error_deg false_flagged good_flagged false_kept good_kept odometry_flagged "
        "cpu_seconds"
    )
    return Table(title, tuple(Column(heading) for heading in headings.split()), tuple(rows))
