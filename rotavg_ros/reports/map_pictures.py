"""Pictures in space: the trajectory before and after, and the graph with its loop closures."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.patheffects import withStroke
from numpy.typing import NDArray

from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.panels import DASHED, View, gaps_between, score_bar, segments, square_map, track
from rotavg_ros.reports.theme import WIDTH, Theme, plain
from rotavg_ros.reports.tracks import Tracks, node_positions, tracks_of

FloatArray = NDArray[np.floating]
Line = tuple[FloatArray, FloatArray, dict[str, Any]]

_BEFORE: dict[str, Any] = {"linewidth": 1.1, "zorder": 2}
_AFTER: dict[str, Any] = {"linewidth": 1.7, "zorder": 3}
_REFERENCE: dict[str, Any] = {"linewidth": 1.0, "linestyle": DASHED, "zorder": 4}
_NAMES_PER_ROW = 4
# Lines of closures become thinner if there are more than this.
_FEW_CLOSURES = 200


def trajectory(facts: RunFacts, theme: Theme) -> Figure | None:
    """Odometry, corrected and reference positions on a map; below it the third axis over time, unless it is flat."""
    robots = tracks_of(facts)
    if not robots:
        return None
    view = View.of([positions for robot in robots for positions in robot.all])
    lines = list(_lines(robots, theme))
    figure = theme.figure(WIDTH, 5.2 if view.is_flat else 6.6)
    if view.is_flat:
        top = figure.subplots()
    else:
        top, bottom = figure.subplots(2, 1, gridspec_kw={"height_ratios": (3, 1)})
        for time, position, line in lines:
            lines_of_time = np.cumsum(np.diff(time, prepend=time[:1]) < 0, dtype=np.int64)  # a clock may have gone back
            bottom.plot(*gaps_between(lines_of_time, time, position[:, view.hidden]), **line)
        bottom.margins(x=0.01)
        theme.dress(bottom, "", facts.clock.unit, view.name(view.hidden))
    for _, position, line in lines:
        track(top, view, position, **line)
    if len(robots) > 1:
        top.plot([], [], color=theme.muted, alpha=0.5, label="odometry alone (pale)", **_BEFORE)
        if any(robot.reference is not None for robot in robots):
            top.plot([], [], color=theme.reference, label="reference", **_REFERENCE)
    _mark_start(top, theme, *view(robots[0].corrected))
    square_map(top)
    rows = -(-len(top.get_legend_handles_labels()[1]) // _NAMES_PER_ROW)
    theme.dress(top, "Trajectory", view.name(view.across), view.name(view.up), legend_rows=rows)
    return figure


def _lines(robots: Sequence[Tracks], theme: Theme) -> Iterator[Line]:
    """Times, positions and line styles: colours distinguish before and after or, if there are several, the robots."""
    several = len(robots) > 1
    for number, robot in enumerate(robots):
        own = theme.line_of(number)
        if robot.odometry is not None:
            before = {**own, "alpha": 0.5} if several else {"color": theme.odometry, "label": "odometry alone"}
            yield robot.time, robot.odometry, {**_BEFORE, **before}
        after = {**own, "label": plain(robot.robot)} if several else {"color": theme.corrected, "label": "corrected"}
        yield robot.time, robot.corrected, {**_AFTER, **after}
        if robot.reference is not None:
            name = {} if several else {"label": "reference"}
            yield robot.time, robot.reference, {"color": theme.reference, **_REFERENCE, **name}


def _mark_start(axes: Axes, theme: Theme, x: FloatArray, y: FloatArray) -> None:
    known = np.flatnonzero(np.isfinite(x) & np.isfinite(y))
    if len(known):
        start = float(x[known[0]]), float(y[known[0]])
        axes.plot(*start, "o", color=theme.ink, markersize=6, zorder=5)
        label = axes.annotate(
            "start", start, (8, -13), textcoords="offset points", fontsize=9, color=theme.ink, zorder=5
        )
        label.set_path_effects([withStroke(linewidth=3, foreground=theme.background)])


def graph(facts: RunFacts, theme: Theme) -> Figure | None:
    """Keyframes at their corrected positions, loop closures between them in the colour of their score."""
    answer, position = facts.record.answer, node_positions(facts)
    ends = np.stack((answer.source[facts.closures], answer.target[facts.closures]), axis=1)
    placed = np.isfinite(position[ends]).all(axis=(1, 2))
    if not placed.any():
        return None
    view = View.of([position])
    figure = theme.figure(WIDTH, 4.8)
    axes = figure.subplots()
    score = answer.outlier_score[facts.closures][placed]
    is_outlier = answer.outlier[facts.closures][placed]
    lines = np.stack(view(position.reshape(-1, 3)), axis=1)[ends[placed]]
    for robot in facts.record.robots:
        track(axes, view, position[robot.nodes], color=theme.muted, linewidth=0.9, zorder=2)
    # False closures cross the whole map; believed ones are drawn on top of them.
    for chosen, width, opacity, order in ((is_outlier, 0.8, 0.55, 1), (~is_outlier, 1.8, 0.95, 3)):
        many = max(float(np.sqrt(chosen.sum() / _FEW_CLOSURES)), 1.0)
        colours = theme.scores(score[chosen])
        segments(axes, lines[chosen], colors=colours, linewidths=width / many**0.5, alpha=opacity / many, zorder=order)
    square_map(axes)
    score_bar(axes, theme)
    theme.dress(axes, "Loop closures on the map", view.name(view.across), view.name(view.up))
    return figure
