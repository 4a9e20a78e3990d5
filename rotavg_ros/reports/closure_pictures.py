"""Pictures of the verdicts on loop closures: their scores, and which moments they connect."""

from __future__ import annotations

import numpy as np
from matplotlib.figure import Figure

from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.panels import score_bar, score_histogram
from rotavg_ros.reports.theme import WIDTH, Theme


def scores(facts: RunFacts, theme: Theme) -> Figure | None:
    """Histogram of the loop closures' scores."""
    if len(facts.closures) == 0:
        return None
    answer = facts.record.answer
    score, flagged = answer.outlier_score[facts.closures], answer.outlier[facts.closures]
    figure = theme.figure(WIDTH, 3.3)
    axes = figure.subplots()
    score_histogram(
        axes, [("believed", score[~flagged], theme.kept), ("flagged as false", score[flagged], theme.flagged)]
    )
    theme.dress(axes, "Loop closures by outlier score", "probability that it is false", "loop closures", legend_rows=1)
    return figure


def matches(facts: RunFacts, theme: Theme) -> Figure | None:
    """Every loop closure as a dot: x is the later of its two moments, y the earlier."""
    answer = facts.record.answer
    ends = np.stack([answer.stamp_ns[nodes[facts.closures]] for nodes in (answer.source, answer.target)])
    timed = (ends >= 0).all(axis=0)
    if not timed.any():
        return None
    time = facts.time(ends[:, timed])
    score = answer.outlier_score[facts.closures][timed]
    order = np.argsort(-score, kind="stable")  # what is believed lies on top
    figure = theme.figure(WIDTH, 4.8)
    axes = figure.subplots()
    last = float(facts.time(answer.stamp_ns).max())
    axes.plot([0, last], [0, last], color=theme.muted, linewidth=0.8)
    axes.scatter(
        time.max(axis=0)[order],
        time.min(axis=0)[order],
        c=score[order],
        cmap=theme.scores,
        vmin=0,
        vmax=1,
        s=float(np.clip(4000 / len(score), 4, 22)),
        linewidths=0,
        zorder=3,
    )
    axes.set_aspect("equal")
    axes.margins(0.02)
    score_bar(axes, theme)
    unit = facts.clock.unit
    theme.dress(axes, "Moments that loop closures connect", f"later moment, {unit}", f"earlier moment, {unit}")
    return figure
