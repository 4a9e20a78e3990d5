"""Pictures of the SLAM suite: error against the share of false closures, and over a run's keyframes."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rotavg_ros.evaluation.plots import BLUE, INK, MUTED, ORANGE, PALETTE, style
from rotavg_ros.evaluation.slam_cases import RANDOM
from rotavg_ros.evaluation.slam_contenders import OURS
from rotavg_ros.evaluation.slam_incremental import SETTLED_KEYFRAMES, IncrementalRun
from rotavg_ros.evaluation.slam_scoring import REFERENCE, SlamScores, geometric_mean

_MARKERS = "osD^vP*X<>"
# Without refinement no closure bends a good odometry, so that these lines would lie on its own.
_LIKE_ODOMETRY = ("cleannet-spt", "spt")
# Characters in a line below the axis.
_LABEL_WIDTH = 9


def ratios(path: Path, scores: SlamScores, rows: dict[str, str], graphs: Sequence[str], title: str) -> None:
    """Geometric mean of the error over the oracle's under every condition, a line per method; a dot is a case of ours.

    Args:
        rows: what to call each contender.
    """
    conditions = [c for c in scores.conditions if scores.ratios(OURS, graphs, c)]
    figure = Figure(figsize=(10, 5.6), dpi=150, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    position = np.arange(len(conditions), dtype=np.float64)
    by_share = np.array([condition.endswith(RANDOM) for condition in conditions])
    for x, condition in enumerate(conditions):
        cases = list(scores.ratios(OURS, graphs, condition).values())
        axes.plot(np.full(len(cases), x), cases, ".", color=BLUE, alpha=0.35, markersize=6, zorder=2)
    others = [name for name in rows if name not in (REFERENCE, OURS, *_LIKE_ODOMETRY)]
    colours = [colour for colour in PALETTE if colour != BLUE]
    for number, name in enumerate((*others, OURS)):
        values = [geometric_mean(scores.ratios(name, graphs, condition).values()) for condition in conditions]
        is_ours = name == OURS
        # A line along the shares; the other conditions stand apart.
        between = int(by_share.sum())
        axes.plot(
            np.insert(position, between, np.nan),
            np.insert(values, between, np.nan),
            marker=_MARKERS[number % len(_MARKERS)],
            color=BLUE if is_ours else colours[number % len(colours)],
            linewidth=2.2 if is_ours else 1.2,
            linestyle="-" if is_ours or number < len(colours) else "--",
            markersize=6 if is_ours else 4,
            label=rows[name].replace("**", "").replace("· ", "ours, "),
            zorder=4 if is_ours else 3,
        )
    axes.axhline(1, color=INK, linewidth=0.9, linestyle=(0, (4, 3)), zorder=1)
    axes.set_yscale("log")
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}×"))
    axes.set_xticks(position, [textwrap.fill(condition, _LABEL_WIDTH) for condition in conditions])
    axes.legend(loc="upper left", bbox_to_anchor=(1.0, 1.0), frameon=False, fontsize=8.5, labelcolor=INK)
    style(axes, title)
    axes.set_xlabel("loop closures that are false", fontsize=9, color=MUTED)
    figure.savefig(path)


def incremental(path: Path, run: IncrementalRun) -> None:
    """Error over keyframes beside odometry alone; below it what was flagged and what changed its flag."""
    figure = Figure(figsize=(10, 6.4), dpi=150, facecolor="white", layout="constrained")
    upper, lower = figure.subplots(2, 1, height_ratios=(2.2, 1), sharex=True)
    upper.plot(run.keyframes, run.odometry_error_deg, color=MUTED, linewidth=1.4, label="odometry alone")
    upper.plot(run.keyframes, run.error_deg, color=BLUE, linewidth=1.6, label="ours, at every tick")
    if run.keyframes[-1] > SETTLED_KEYFRAMES:
        upper.axvline(SETTLED_KEYFRAMES, color=MUTED, linewidth=0.8, linestyle=(0, (4, 3)))
    upper.set_ylim(bottom=0)
    upper.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}°"))
    upper.legend(loc="upper left", frameon=False, fontsize=9, labelcolor=INK)
    style(upper, f"{run.case.name}: mean error of all keyframes so far")
    lower.plot(run.keyframes, run.false_seen - run.false_flagged, color=ORANGE, linewidth=1.3, label="false, believed")
    lower.plot(run.keyframes, run.good_flagged, color=BLUE, linewidth=1.3, label="good, called false")
    lower.vlines(run.keyframes, 0, -run.flips, color=MUTED, linewidth=1.0, label="flags that flip (downwards)")
    lower.legend(loc="upper left", frameon=False, fontsize=9, labelcolor=INK, ncols=3)
    style(lower, "")
    lower.set_ylabel("loop closures", fontsize=9, color=MUTED)
    lower.set_xlabel("keyframes", fontsize=9, color=MUTED)
    figure.savefig(path)
