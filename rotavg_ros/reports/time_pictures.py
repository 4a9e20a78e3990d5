"""Pictures over time: errors, uncertainty, ticks, growth, verdicts that changed."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from rotavg_ros.replay.record import RobotRecord
from rotavg_ros.reports.facts import RunFacts
from rotavg_ros.reports.panels import Curves, PlainLogFormatter, counts_over_time, over_time
from rotavg_ros.reports.theme import WIDTH, Theme, plain

FloatArray = NDArray[np.float64]

MOST_ROBOTS = 6  # with a panel of their own
_LEAVES_THE_PLANE = np.radians(0.5)


def orientation(facts: RunFacts, theme: Theme) -> Figure | None:
    """Error of the orientations; without a reference, the rotation from odometry to the answer."""
    compared = list(facts.compared)[:MOST_ROBOTS]
    if not compared:
        return _correction(facts, theme)
    with_heading = len(compared) == 1 and _leaves_the_plane(facts)
    figure, panels = _column(facts, theme, len(compared) + with_heading)
    for axes, (robot, errors) in zip(panels, compared, strict=False):
        before, after = np.degrees(errors.odometry.angle), np.degrees(errors.corrected.angle)
        curves = {
            _with_mean("odometry alone", before, "°"): (before, theme.odometry),
            _with_mean("corrected", after, "°"): (after, theme.corrected),
        }
        over_time(axes, facts.time(robot.stamp_ns), curves, "°", time_line=robot.time_line)
        theme.dress(axes, _of_robot("Orientation error", robot.robot, facts), axes.get_xlabel(), legend_rows=1)
    if with_heading:
        robot, errors = compared[0]
        headings: Curves = {
            "odometry alone": (np.degrees(errors.odometry.heading), theme.odometry),
            "corrected": (np.degrees(errors.corrected.heading), theme.corrected),
        }
        times, lines = facts.time(robot.stamp_ns), robot.time_line
        over_time(panels[-1], times, headings, "°", time_line=lines, from_zero=False)
        theme.dress(panels[-1], "Heading error, about z", facts.clock.unit)
    return figure


def _leaves_the_plane(facts: RunFacts) -> bool:
    """Whether the orientation error exceeds the heading error noticeably."""
    angle, heading = (getattr(errors.odometry, name) for _, errors in facts.compared for name in ("angle", "heading"))
    return bool(np.nanmax(np.abs(angle - np.abs(heading)), initial=0.0) > _LEAVES_THE_PLANE)


def _correction(facts: RunFacts, theme: Theme) -> Figure | None:
    curves = [
        (robot, np.degrees(turned))
        for robot, turned in zip(facts.record.robots, facts.correction, strict=True)
        if np.isfinite(turned).any()
    ]
    if not curves:
        return None
    return _one_line_per_robot(facts, theme, curves, "How far the answer turns the odometry", "°")


def position_error(facts: RunFacts, theme: Theme) -> Figure | None:
    """Distance to the reference, before and after."""
    compared = [
        (robot, errors)
        for robot, errors in facts.compared
        if np.isfinite(errors.corrected_distance).any() or np.isfinite(errors.odometry_distance).any()
    ][:MOST_ROBOTS]
    if not compared:
        return None
    figure, panels = _column(facts, theme, len(compared))
    for axes, (robot, errors) in zip(panels, compared, strict=True):
        curves = {
            _with_mean("odometry alone", errors.odometry_distance, " m"): (errors.odometry_distance, theme.odometry),
            _with_mean("corrected", errors.corrected_distance, " m"): (errors.corrected_distance, theme.corrected),
        }
        over_time(axes, facts.time(robot.stamp_ns), curves, " m", time_line=robot.time_line)
        theme.dress(axes, _of_robot("Position error", robot.robot, facts), axes.get_xlabel(), legend_rows=1)
    return figure


def uncertainty(facts: RunFacts, theme: Theme) -> Figure | None:
    """One sigma of every keyframe's orientation."""
    answer = facts.record.answer
    curves = [
        (robot, np.degrees(robot.uncertainty)) for robot in facts.record.robots if np.isfinite(robot.uncertainty).any()
    ]
    if not curves or len(answer.stamp_ns) == 0:
        return None
    return _one_line_per_robot(facts, theme, curves, "Uncertainty of the orientations, 1σ", "°")


def ticks(facts: RunFacts, theme: Theme) -> Figure | None:
    """Duration of every tick, and growth of the graph."""
    ticks = facts.record.ticks
    if not ticks:
        return None
    time = facts.tick_time
    milliseconds = np.array([1000 * tick.seconds for tick in ticks])
    cold = np.array([tick.was_cold for tick in ticks])
    figure = theme.figure(WIDTH, 4.6)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (1.3, 1)})
    for name, chosen, colour, marker in (("warm", ~cold, theme.corrected, "."), ("cold", cold, theme.odometry, "D")):
        if chosen.any():
            label = f"{name} ({int(chosen.sum())})"
            upper.plot(time[chosen], milliseconds[chosen], marker, color=colour, markersize=4, label=label)
    # A first run on a machine compiles for a minute, other ticks take milliseconds.
    upper.set_yscale("log")
    upper.yaxis.set_major_formatter(PlainLogFormatter())
    upper.yaxis.set_minor_formatter(PlainLogFormatter())  # where the ticks span less than a decade
    upper.margins(x=0.02, y=0.15)
    theme.dress(upper, "Time of every tick", y="milliseconds", legend_rows=1)
    keyframes, edges = [tick.keyframes for tick in ticks], [tick.edges for tick in ticks]
    growth = {
        f"keyframes ({keyframes[-1]})": (keyframes, theme.corrected),
        f"edges ({edges[-1]})": (edges, theme.odometry),
    }
    counts_over_time(lower, time, growth)
    theme.dress(lower, "Growth of the graph", facts.clock.unit, "count", legend_rows=1)
    return figure


def flips(facts: RunFacts, theme: Theme) -> Figure | None:
    """Edges that are flagged, and flags that changed, by tick."""
    ticks = facts.record.ticks
    if not ticks or len(facts.closures) == 0:
        return None
    time = facts.tick_time
    changed = np.array([tick.flips for tick in ticks])
    figure = theme.figure(WIDTH, 4.2)
    upper, lower = figure.subplots(2, 1, sharex=True, gridspec_kw={"height_ratios": (1.3, 1)})
    counts_over_time(upper, time, {"flagged": ([tick.outliers for tick in ticks], theme.flagged)})
    upper.margins(x=0.02)
    theme.dress(upper, "Edges flagged as false so far", y="edges")
    lower.vlines(time, 0, changed, color=theme.ink, linewidth=1.4)
    lower.set_ylim(0, max(1.1 * float(changed.max(initial=0)), 1.0))
    theme.dress(lower, f"Verdicts that changed from one tick to the next ({int(changed.sum())})", facts.clock.unit)
    lower.set_ylabel("edges", fontsize=9, color=theme.muted)
    lower.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))
    return figure


def _one_line_per_robot(
    facts: RunFacts, theme: Theme, curves: Sequence[tuple[RobotRecord, FloatArray]], title: str, unit: str
) -> Figure:
    figure, (axes,) = _column(facts, theme, 1)
    several = len(curves) > 1
    for number, (robot, values) in enumerate(curves):
        line = theme.line_of(number)
        curve = {plain(robot.robot): (values, line["color"])}
        over_time(axes, facts.time(robot.stamp_ns), curve, unit, time_line=robot.time_line)
        axes.lines[-1].set_linestyle(line["linestyle"])
    theme.dress(axes, title, facts.clock.unit, legend_rows=-(-len(curves) // 4) if several else 0)
    return figure


def _column(facts: RunFacts, theme: Theme, count: int) -> tuple[Figure, list[Axes]]:
    """Panels one above the other; the last one labels the time axis."""
    figure = theme.figure(WIDTH, 1.0 + 2.3 * count)
    panels = list(figure.subplots(count, 1, sharex=True, squeeze=False)[:, 0])
    panels[-1].set_xlabel(facts.clock.unit)
    return figure, panels


def _of_robot(what: str, robot: str, facts: RunFacts) -> str:
    return f"{what} of {plain(robot)}" if len(facts.record.robots) > 1 else what


def _with_mean(name: str, values: FloatArray, unit: str) -> str:
    known = values[np.isfinite(values)]
    return f"{name}, mean {known.mean():.2f}{unit}" if len(known) else name
