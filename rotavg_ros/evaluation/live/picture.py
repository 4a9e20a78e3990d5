"""A picture of a played run: the trajectory with its loop closures, errors over time, and the closures' scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from rotavg_ros.evaluation.live.played_run import LiveReport
from rotavg_ros.reports.panels import DASHED, Clock, over_time, score_histogram, segments, square_map
from rotavg_ros.reports.theme import LIGHT, drawable

_KEPT = LIGHT.robots[1]  # the corrected trajectory beside it is blue


def draw(report: LiveReport, path: Path, title: str) -> None:
    """Write a PNG (or another format by suffix) of 2100 × 1200 pixels."""
    figure = Figure(figsize=(14, 8), dpi=150, facecolor="white")
    grid = figure.add_gridspec(
        2, 2, width_ratios=(1.45, 1), left=0.03, right=0.97, top=0.82, bottom=0.13, wspace=0.1, hspace=0.5
    )
    heading = drawable(title)
    figure.text(0.03, 0.95, heading, fontsize=17, fontweight="bold", color=LIGHT.ink, va="center", parse_math=False)
    figure.text(0.03, 0.907, _subtitle(report), fontsize=11, color=LIGHT.muted, va="center")
    _draw_map(figure.add_subplot(grid[:, 0]), report)
    right = [_draw_errors] if report.knows_errors else []
    right += [_draw_scores] if len(report.closure_score) else []
    for row, draw_panel in enumerate(right):
        draw_panel(figure.add_subplot(grid[row, 1] if len(right) == 2 else grid[:, 1]), report)
    figure.savefig(path)


def _subtitle(report: LiveReport) -> str:
    closures = len(report.closure_ends)
    words = [f"{len(report.seconds)} keyframes", f"{closures} loop closures"]
    if report.knows_errors:
        odometry, corrected = (
            np.degrees(np.nanmean(error)) for error in (report.odometry_error, report.corrected_error)
        )
        words.append(f"mean orientation error {odometry:.2f}° → {corrected:.2f}°")
    if report.verdicts is not None:
        counts = report.verdicts
        words.append(
            f"{counts.true_positives} of {counts.true_positives + counts.false_negatives} false closures found"
        )
        words.append(f"{counts.false_positives} good ones flagged")
    else:
        words.append(f"{int(report.closure_flagged.sum())} flagged as false")
    return "   ·   ".join(words)


def _verdict_groups(report: LiveReport) -> list[tuple[str, NDArray[np.bool_], str, float, float]]:
    """Closures by verdict: name, mask, colour, line width, opacity."""
    flagged, false, good = report.closure_flagged, report.closure_is_false == 1, report.closure_is_false == 0
    unknown = ~false & ~good
    return [
        ("flagged, truth unknown", flagged & unknown, LIGHT.flagged, 0.7, 0.45),
        ("false closure, flagged", flagged & false, LIGHT.flagged, 0.7, 0.45),
        ("closure kept", ~flagged & ~false, _KEPT, 1.6, 0.9),
        ("good closure, flagged", flagged & good, LIGHT.wrongly_flagged, 1.8, 1.0),
        ("false closure, missed", ~flagged & false, LIGHT.missed, 1.8, 1.0),
    ]


def _draw_map(axes: Axes, report: LiveReport) -> None:
    handles = []
    for name, mask, colour, width, opacity in _verdict_groups(report):
        if not mask.any():
            continue
        ends = report.corrected_position[report.closure_ends[mask]][:, :, :2]
        segments(axes, ends, colors=colour, linewidths=width, alpha=opacity, zorder=2)
        handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{name} ({int(mask.sum())})"))
    lines = []
    for name, position, colour, width, style, order in (
        ("odometry alone", report.odometry_position, LIGHT.odometry, 1.1, "-", 1),
        ("corrected", report.corrected_position, LIGHT.corrected, 1.5, "-", 3),
        ("truth", report.true_position, LIGHT.reference, 0.9, DASHED, 4),
    ):
        if np.isfinite(position).any():
            lines += axes.plot(
                position[:, 0], position[:, 1], color=colour, linewidth=width, linestyle=style, label=name, zorder=order
            )
    start = report.corrected_position[0]
    axes.plot(start[0], start[1], "o", color=LIGHT.ink, markersize=6, zorder=5)
    axes.annotate(
        "start", start[:2], xytext=(8, -13), textcoords="offset points", fontsize=9, color=LIGHT.ink, zorder=5
    )
    square_map(axes)
    LIGHT.dress(axes, "Seen from above, metres")
    axes.legend(
        handles=[*reversed(lines), *handles],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.045),
        ncols=4,
        frameon=False,
        fontsize=9,
        labelcolor=LIGHT.ink,
    )


def _draw_errors(axes: Axes, report: LiveReport) -> None:
    clock = Clock.for_duration(float(report.seconds.max(initial=0.0)))
    curves = {
        f"{name}, mean {np.degrees(np.nanmean(error)):.2f}°": (np.degrees(error), colour)
        for name, error, colour in (
            ("odometry alone", report.odometry_error, LIGHT.odometry),
            ("corrected", report.corrected_error, LIGHT.corrected),
        )
    }
    over_time(axes, clock(report.seconds), curves, "°")
    LIGHT.dress(axes, "Orientation error after one common rotation", clock.unit, legend_rows=1)


def _draw_scores(axes: Axes, report: LiveReport) -> None:
    unknown = ~np.isfinite(report.closure_is_false)
    groups = [
        ("good closures", report.closure_score[report.closure_is_false == 0], _KEPT),
        ("false closures", report.closure_score[report.closure_is_false == 1], LIGHT.flagged),
        ("truth unknown", report.closure_score[unknown], LIGHT.muted),
    ]
    score_histogram(axes, groups)
    legend = 1 if len(report.closure_score) else 0
    LIGHT.dress(axes, "Loop closures by outlier score", "probability that it is false", legend_rows=legend)
