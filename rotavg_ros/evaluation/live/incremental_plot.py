"""The picture of an incremental run, over its keyframes."""

from __future__ import annotations

from pathlib import Path

from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rotavg_ros.evaluation.common.plots import BLUE, INK, MUTED, ORANGE, style
from rotavg_ros.evaluation.live.incremental import SETTLED_KEYFRAMES, IncrementalRun


def draw(path: Path, run: IncrementalRun) -> None:
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
    style(upper, f"{run.case.key}: mean error of all keyframes so far")
    lower.plot(run.keyframes, run.false_seen - run.false_flagged, color=ORANGE, linewidth=1.3, label="false, believed")
    lower.plot(run.keyframes, run.good_flagged, color=BLUE, linewidth=1.3, label="good, called false")
    lower.vlines(run.keyframes, 0, -run.flips, color=MUTED, linewidth=1.0, label="flags that flip (downwards)")
    lower.legend(loc="upper left", frameon=False, fontsize=9, labelcolor=INK, ncols=3)
    style(lower, "")
    lower.set_ylabel("loop closures", fontsize=9, color=MUTED)
    lower.set_xlabel("keyframes", fontsize=9, color=MUTED)
    figure.savefig(path)
