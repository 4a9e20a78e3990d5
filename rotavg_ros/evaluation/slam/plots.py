"""The picture of the SLAM suite: error against the share of false closures."""

from __future__ import annotations

import textwrap
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter

from rotavg_ros.evaluation.common.plots import BLUE, INK, MUTED, PALETTE, style
from rotavg_ros.evaluation.common.scoring import Scores, geometric_mean
from rotavg_ros.evaluation.slam.cases import RANDOM
from rotavg_ros.evaluation.slam.contenders import ORACLE, OURS

_MARKERS = "osD^vP*X<>"
# Without refinement no closure bends a good odometry, so that these lines would lie on its own.
_LIKE_ODOMETRY = ("cleannet-spt", "spt")
# Characters in a line below the axis.
_LABEL_WIDTH = 9


def ratios(path: Path, scores: Scores, rows: dict[str, str], title: str) -> None:
    """Geometric mean of the error over the oracle's under every condition, a line per method; a dot is a case of ours.

    Args:
        rows: displayed name of each contender.
    """
    conditions = [kind for kind in scores.kinds if scores.ratios(OURS, ORACLE, "floored_deg", kind)]
    figure = Figure(figsize=(10, 5.6), dpi=150, facecolor="white", layout="constrained")
    axes = figure.add_subplot()
    position = np.arange(len(conditions), dtype=np.float64)
    by_share = np.array([condition.endswith(RANDOM) for condition in conditions])
    for x, condition in enumerate(conditions):
        cases = list(scores.ratios(OURS, ORACLE, "floored_deg", condition).values())
        axes.plot(np.full(len(cases), x), cases, ".", color=BLUE, alpha=0.35, markersize=6, zorder=2)
    others = [name for name in rows if name not in (ORACLE, OURS, *_LIKE_ODOMETRY)]
    colours = [colour for colour in PALETTE if colour != BLUE]
    for number, name in enumerate((*others, OURS)):
        values = [
            geometric_mean(scores.ratios(name, ORACLE, "floored_deg", condition).values()) for condition in conditions
        ]
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
