"""The table of incremental runs."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.evaluation.live.incremental import SETTLED_KEYFRAMES, IncrementalRun


def incremental(title: str, runs: Sequence[IncrementalRun]) -> Table:
    """Errors, flips, verdicts and times of graphs that were played edge by edge."""
    rows: list[tuple[Cell, ...]] = [
        (
            str(run.case.key),
            run.error_deg[-1],
            run.odometry_error_deg[-1],
            run.worst_excess_deg,
            float(run.flips.mean()),
            int(run.flips.max()),
            100 * _share(run.false_flagged[-1], run.false_seen[-1]),
            100 * _share(run.good_flagged[-1], run.good_seen[-1]),
            1e3 * float(np.median(run.seconds)),
            1e3 * float(np.percentile(run.seconds, 95)),
            1e3 * float(np.median(run.after_seconds)),
            1e3 * float(np.percentile(run.after_seconds, 95)),
        )
        for run in runs
    ]
    columns = (
        Column("run"),
        Column("final °", ".2f"),
        Column("odometry °", ".2f"),
        Column(f"worst excess ° after {SETTLED_KEYFRAMES}", ".2f"),
        Column("flips per tick", ".3f"),
        Column("most flips", "d"),
        Column("false flagged %", ".1f"),
        Column("good flagged %", ".1f"),
        Column("answer p50 ms", ".0f"),
        Column("answer p95 ms", ".0f"),
        Column("after it p50 ms", ".0f"),
        Column("after it p95 ms", ".0f"),
    )
    note = (
        "Edges in time order, a tick every ten keyframes; errors are of all keyframes so far. Excess: how much worse "
        "than odometry alone at the same keyframe. Flips: closures seen before whose flag a tick changes. Wall-clock "
        "milliseconds until a tick's answer, and of the work that goes on after it."
    )
    return Table(title, columns, tuple(rows), (note,))


def _share(part: float, whole: float) -> float:
    return part / whole if whole else float("nan")
