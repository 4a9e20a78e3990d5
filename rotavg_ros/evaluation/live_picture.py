"""A picture of a played run: the trajectory with its loop closures, errors over time, and the closures' scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from numpy.typing import NDArray

from rotavg_ros.evaluation.live_report import LiveReport

_INK, _MUTED, _GRID = "#1f2933", "#7b8794", "#e4e7eb"
_TRUTH, _ODOMETRY, _CORRECTED = "#1f2933", "#e8833a", "#2368c4"
_ABOVE_LEGEND = 26.0  # points
_KEPT, _FLAGGED, _MISSED, _WRONGLY_FLAGGED = "#2a9d7f", "#d64545", "#b0269e", "#e0b400"


def draw(report: LiveReport, path: Path, title: str) -> None:
    """Write a PNG (or what else the suffix says) of 2100 × 1200 pixels."""
    figure = Figure(figsize=(14, 8), dpi=150, facecolor="white")
    grid = figure.add_gridspec(
        2, 2, width_ratios=(1.45, 1), left=0.03, right=0.97, top=0.82, bottom=0.13, wspace=0.1, hspace=0.5
    )
    figure.text(0.03, 0.95, title, fontsize=17, fontweight="bold", color=_INK, va="center")
    figure.text(0.03, 0.907, _subtitle(report), fontsize=11, color=_MUTED, va="center")
    _draw_map(figure.add_subplot(grid[:, 0]), report)
    if report.knows_errors:
        _draw_errors(figure.add_subplot(grid[0, 1]), report)
        _draw_scores(figure.add_subplot(grid[1, 1]), report)
    else:
        _draw_scores(figure.add_subplot(grid[:, 1]), report)
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
        ("flagged, truth unknown", flagged & unknown, _FLAGGED, 0.7, 0.45),
        ("false closure, flagged", flagged & false, _FLAGGED, 0.7, 0.45),
        ("closure kept", ~flagged & ~false, _KEPT, 1.6, 0.9),
        ("good closure, flagged", flagged & good, _WRONGLY_FLAGGED, 1.8, 1.0),
        ("false closure, missed", ~flagged & false, _MISSED, 1.8, 1.0),
    ]


def _draw_map(axes: Axes, report: LiveReport) -> None:
    handles = []
    for name, mask, colour, width, opacity in _verdict_groups(report):
        if not mask.any():
            continue
        segments = report.corrected_position[report.closure_ends[mask]][:, :, :2]
        axes.add_collection(LineCollection(list(segments), colors=colour, linewidths=width, alpha=opacity, zorder=2))
        handles.append(Line2D([], [], color=colour, linewidth=2, label=f"{name} ({int(mask.sum())})"))
    lines = []
    for name, position, colour, width, style, order in (
        ("odometry alone", report.odometry_position, _ODOMETRY, 1.1, "-", 1),
        ("corrected", report.corrected_position, _CORRECTED, 1.5, "-", 3),
        ("truth", report.true_position, _TRUTH, 0.9, (0, (4, 3)), 4),
    ):
        if np.isfinite(position).any():
            lines += axes.plot(
                position[:, 0], position[:, 1], color=colour, linewidth=width, linestyle=style, label=name, zorder=order
            )
    start = report.corrected_position[0]
    axes.plot(start[0], start[1], "o", color=_INK, markersize=6, zorder=5)
    axes.annotate("start", start[:2], xytext=(8, -13), textcoords="offset points", fontsize=9, color=_INK, zorder=5)
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    _style(axes, "Seen from above, metres")
    axes.legend(
        handles=[*reversed(lines), *handles],
        loc="upper center",
        bbox_to_anchor=(0.5, -0.045),
        ncols=4,
        frameon=False,
        fontsize=9,
        labelcolor=_INK,
    )


def _draw_errors(axes: Axes, report: LiveReport) -> None:
    minutes = report.seconds / 60
    known = np.isfinite(report.corrected_error)
    order = np.argsort(minutes[known], kind="stable")
    for name, error, colour in (
        ("odometry alone", report.odometry_error, _ODOMETRY),
        ("corrected", report.corrected_error, _CORRECTED),
    ):
        degrees = np.degrees(error[known])[order]
        axes.plot(minutes[known][order], degrees, color=colour, linewidth=1.4)
        axes.fill_between(minutes[known][order], degrees, color=colour, alpha=0.12, linewidth=0)
        axes.plot([], [], color=colour, linewidth=2, label=f"{name}, mean {np.nanmean(degrees):.2f}°")
    axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    _style(axes, "Orientation error after one common rotation, degrees", _ABOVE_LEGEND)
    axes.set_xlabel("minutes", fontsize=9, color=_MUTED)
    _legend_above(axes)


def _draw_scores(axes: Axes, report: LiveReport) -> None:
    bins = np.linspace(0, 1, 26).tolist()
    known = np.isfinite(report.closure_is_false)
    groups = [
        ("good closures", report.closure_score[report.closure_is_false == 0], _KEPT),
        ("false closures", report.closure_score[report.closure_is_false == 1], _FLAGGED),
        ("truth unknown", report.closure_score[~known], _MUTED),
    ]
    groups = [group for group in groups if len(group[1])]
    if groups:
        names, scores, colours = zip(*groups, strict=True)
        labels = [f"{name} ({len(values)})" for name, values in zip(names, scores, strict=True)]
        axes.hist(scores, bins=bins, stacked=True, color=colours, label=labels, alpha=0.9, rwidth=0.9)
        axes.set_yscale("symlog", linthresh=10)
        _legend_above(axes)
    axes.set_xlim(-0.01, 1.01)
    axes.set_ylim(bottom=0)
    _style(axes, "Loop closures by outlier score", _ABOVE_LEGEND)
    axes.set_xlabel("probability that the closure is false", fontsize=9, color=_MUTED)


def _legend_above(axes: Axes) -> None:
    axes.legend(
        loc="lower left",
        bbox_to_anchor=(-0.015, 0.985),
        ncols=3,
        frameon=False,
        fontsize=9,
        labelcolor=_INK,
        handlelength=1.2,
        columnspacing=1.2,
    )


def _style(axes: Axes, title: str, title_pad: float = 8) -> None:
    axes.set_title(title, loc="left", fontsize=11, color=_INK, pad=title_pad)
    axes.grid(color=_GRID, linewidth=0.7)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_MUTED, labelsize=9, length=0)
    for side in axes.spines.values():
        side.set_visible(False)
