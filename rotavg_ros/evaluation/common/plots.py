"""Pictures of results: errors by method, reliability of scores."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rotavg_ros.evaluation.common.scoring import Scores
from rotavg_ros.metrics import CalibrationBins
from rotavg_ros.reports import theme

INK, MUTED, GRID = "#1f2933", "#7b8794", "#e4e7eb"
BLUE, ORANGE = "#2368c4", "#e8833a"
PALETTE = (BLUE, ORANGE, "#2a9d7f", "#b0269e", "#7b8794", "#e0b400")
_DASHED = (0, (4, 3))


def errors(path: Path, scores: Scores, rows: dict[str, str], title: str, reference: str) -> None:
    """Mean and median error of every method, averaged over the graphs, on a logarithmic axis.

    Args:
        rows: displayed name of each contender, in order from the top.
        reference: the contender whose averages are drawn as lines through the picture.
    """
    solved = {name: label for name, label in rows.items() if scores.of(name)}
    figure = Figure(figsize=(10, 1.6 + 0.34 * len(solved)), dpi=150, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    position = np.arange(len(solved))
    for shift, attribute, colour, label in ((-0.17, "mean_deg", BLUE, "mean"), (0.17, "median_deg", ORANGE, "median")):
        for y, name in zip(position, solved, strict=True):
            values = [getattr(row, attribute) for row in scores.of(name).values()]
            axes.plot(values, np.full(len(values), y + shift), ".", color=colour, alpha=0.25, markersize=5, zorder=2)
        averages = [scores.mean(name, attribute) for name in solved]
        axes.plot(averages, position + shift, "D", color=colour, markersize=6, zorder=3, label=f"{label} error")
        if reference in solved:
            axes.axvline(scores.mean(reference, attribute), color=colour, linewidth=0.9, linestyle=_DASHED, zorder=1)
    axes.set_yticks(position, list(solved.values()))
    axes.set_ylim(len(solved) - 0.5, -0.5)
    axes.set_xscale("log")
    axes.xaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}°"))
    axes.xaxis.set_minor_formatter(FuncFormatter(lambda value, _: f"{value:g}°" if _leading(value) in (2, 5) else ""))
    axes.legend(loc="lower right", frameon=True, edgecolor="none", fontsize=9, labelcolor=INK)
    style(axes, title)
    figure.savefig(path)


def reliability(path: Path, calibration: dict[str, CalibrationBins], title: str) -> None:
    """Observed share of outliers over the stated probability, and how many edges state it."""
    figure = Figure(figsize=(7, 7), dpi=150, facecolor="white", layout="constrained")
    upper, lower = figure.subplots(2, 1, height_ratios=(3, 1), sharex=True)
    upper.plot([0, 1], [0, 1], color=MUTED, linewidth=1, linestyle=_DASHED)
    for number, (label, bins) in enumerate(calibration.items()):
        rows, line = bins.rows, {**line_of(number), "marker": "o"}
        upper.plot(rows[:, 1], rows[:, 2], **line, linewidth=1.4, markersize=4, label=f"{label}: {bins.error:.3f}")
        lower.plot(rows[:, 1], rows[:, 0] / rows[:, 0].sum(), **line, linewidth=1.2, markersize=3)
    upper.legend(title="expected calibration error", frameon=False, fontsize=9, title_fontsize=9, labelcolor=INK)
    lower.set_yscale("log")
    lower.set_xlim(-0.02, 1.02)
    style(upper, title)
    upper.set_ylabel("observed share of outliers", fontsize=9, color=MUTED)
    style(lower, "")
    lower.set_ylabel("share of edges", fontsize=9, color=MUTED)
    lower.set_xlabel("stated probability of being an outlier", fontsize=9, color=MUTED)
    figure.savefig(path)


def line_of(number: int) -> dict[str, str]:
    """Colour and style of a picture's lines, counted from 0; they differ up to twice as many as there are colours."""
    return {"color": PALETTE[number % len(PALETTE)], "linestyle": "-" if number < len(PALETTE) else "--"}


def style(axes: Axes, title: str) -> None:
    """The look of all pictures of the evaluation."""
    theme.style(axes, title, ink=INK, muted=MUTED, grid=GRID)


def _leading(value: float) -> int:
    """First significant digit."""
    return int(np.rint(value / 10 ** np.floor(np.log10(value))))
