"""Panels that pictures are composed of; each draws plain arrays on axes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.cm import ScalarMappable
from matplotlib.collections import LineCollection
from matplotlib.colors import Normalize
from matplotlib.ticker import FuncFormatter, LogFormatter, MaxNLocator
from numpy.typing import NDArray

from rotavg_ros.reports.theme import Theme

FloatArray = NDArray[np.floating]
# Values and colour by name, from back to front.
Curves = Mapping[str, tuple[FloatArray, str]]

DASHED = (0, (4, 3))
_AXIS_NAMES = "xyz"
_COUNT_TICKS = [0, 2, 5, *(digit * 10**power for power in range(1, 9) for digit in (1, 2, 5))]
_FEW_POINTS = 12
_FLAT = 0.02  # a run is flat if its ratio of height to width is at most this


@dataclass(frozen=True)
class Clock:
    """Times of a run in the unit that suits its length.

    Attributes:
        unit: name of the unit, for an axis.
        seconds: length of the unit.
    """

    unit: str
    seconds: float

    @classmethod
    def for_duration(cls, seconds: float) -> Clock:
        if seconds < 180:
            return cls("seconds", 1.0)
        return cls("minutes", 60.0) if seconds < 3 * 3600 else cls("hours", 3600.0)

    def __call__(self, seconds: FloatArray) -> FloatArray:
        return seconds / self.seconds


@dataclass(frozen=True)
class View:
    """Which two of the three axes a map shows: those along which the run is longest.

    Attributes:
        across, up: indices of the axes.
        hidden: index of the third.
        is_flat: whether the third axis can be left out without loss.
    """

    across: int
    up: int
    hidden: int
    is_flat: bool

    @classmethod
    def of(cls, positions: Sequence[FloatArray]) -> View:
        """The view for all positions, ``(·, 3)`` each; NaN rows do not count."""
        points = np.concatenate([np.reshape(position, (-1, 3)) for position in positions] or [np.empty((0, 3))])
        points = points[np.isfinite(points).all(axis=1)]
        extent = np.ptp(points, axis=0) if len(points) else np.array([1.0, 1.0, 0.0])
        # For equal extents, as when the robot stands still, the vertical is left out.
        hidden = 2 - int(np.argmin(extent[::-1]))
        across, up = (axis for axis in range(3) if axis != hidden)
        return cls(across, up, hidden, bool(extent[hidden] <= _FLAT * extent.max()))

    def __call__(self, position: FloatArray) -> tuple[FloatArray, FloatArray]:
        return position[:, self.across], position[:, self.up]

    def name(self, axis: int) -> str:
        return f"{_AXIS_NAMES[axis]}, metres"


def track(axes: Axes, view: View, position: FloatArray, **line: Any) -> None:
    """A trajectory with gaps where positions are unknown. If there are few positions, they are drawn as dots."""
    x, y = view(position)
    known = np.isfinite(x) & np.isfinite(y)
    if known.any():
        axes.plot(x, y, marker=_marker(int(known.sum())), markersize=4, solid_joinstyle="round", **line)


def _marker(count: int) -> str:
    return "o" if count <= _FEW_POINTS else ""


def segments(axes: Axes, ends: FloatArray, **lines: Any) -> LineCollection:
    """Straight lines between ``(·, 2, 2)`` ends."""
    collection = LineCollection(list(ends), **lines)
    axes.add_collection(collection)
    return collection


def square_map(axes: Axes) -> None:
    """Use the same scale on both axes."""
    axes.set_aspect("equal", adjustable="datalim")
    axes.margins(0.06)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(nbins=6, integer=False))


def counts_over_time(axes: Axes, time: FloatArray, curves: Mapping[str, tuple[Sequence[int], str]]) -> None:
    """Counts and colours by name over ascending times: steps from zero, with whole numbers on the axis."""
    for name, (counts, colour) in curves.items():
        look: dict[str, Any] = {"marker": _marker(len(counts)), "markersize": 4, "linewidth": 1.4}
        axes.plot(time, counts, drawstyle="steps-post", color=colour, label=name, **look)
    most = max((max(counts, default=0) for counts, _ in curves.values()), default=0)
    axes.set_ylim(0, max(1.05 * most, 1.0))
    axes.yaxis.set_major_locator(MaxNLocator(nbins=5, integer=True))


def gaps_between(time_line: NDArray[np.int64], *rows: FloatArray) -> tuple[FloatArray, ...]:
    """Each of several ``(n, …)`` arrays with a row of NaN where a new one of ``(n,)`` ascending time lines begins."""
    begins = np.flatnonzero(np.diff(time_line)) + 1
    return tuple(np.insert(np.asarray(each, dtype=np.float64), begins, np.nan, axis=0) for each in rows)


def over_time(
    axes: Axes,
    time: FloatArray,
    curves: Curves,
    unit: str,
    *,
    time_line: NDArray[np.int64] | None = None,
    from_zero: bool = True,
) -> None:
    """Curves over times in any order; unknown values are left out. Called again, it adds to what is drawn.

    Args:
        unit: appended to the numbers on the axis.
        time_line: of each time, where a clock went back; each has a line of its own. Default: one.
        from_zero: whether the axis begins at zero and the area below a curve is tinted.
    """
    line = np.zeros(len(time), dtype=np.int64) if time_line is None else time_line
    order = np.lexsort((time, line))
    axes.set_autoscaley_on(True)  # the limit below ends it, and these curves may be higher than earlier ones
    for name, (values, colour) in curves.items():
        known = order[np.isfinite(values[order])]
        look: dict[str, Any] = {"marker": _marker(len(known)), "markersize": 4, "linewidth": 1.4}
        x, y = gaps_between(line[known], time[known], values[known])
        axes.plot(x, y, color=colour, label=name, **look)
        if from_zero:
            axes.fill_between(x, y, color=colour, alpha=0.12, linewidth=0)
    if from_zero:
        axes.set_ylim(bottom=0)
    axes.margins(x=0.01)
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}{unit}"))


def score_histogram(axes: Axes, groups: Sequence[tuple[str, FloatArray, str]]) -> None:
    """Scores from 0 to 1 in stacked groups of name, values and colour; small and large counts are both visible."""
    groups = [group for group in groups if len(group[1])]
    if groups:
        names, scores, colours = zip(*groups, strict=True)
        axes.hist(
            scores,
            bins=np.linspace(0, 1, 26).tolist(),
            stacked=True,
            color=colours,
            label=[f"{name} ({len(values)})" for name, values in zip(names, scores, strict=True)],
            rwidth=0.9,
        )
        axes.set_yscale("symlog", linthresh=10)
        most = axes.get_ylim()[1]
        axes.set_yticks([0, 1] if most < 2 else [tick for tick in _COUNT_TICKS if tick <= most])
        axes.minorticks_off()
        axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlim(-0.01, 1.01)
    axes.set_ylim(bottom=0)


class PlainLogFormatter(LogFormatter):
    """Writes 60 where matplotlib has 6 × 10¹, and labels the same ticks as it does."""

    def __call__(self, value: float, position: int | None = None) -> str:
        return f"{value:g}" if super().__call__(value, position) else ""


def score_bar(axes: Axes, theme: Theme, label: str = "outlier score") -> None:
    """A colour bar of scores beside a panel."""
    bar = axes.figure.colorbar(ScalarMappable(Normalize(0, 1), theme.scores), ax=axes, shrink=0.75, pad=0.02)
    bar.set_label(label, fontsize=9, color=theme.muted)
    bar.ax.tick_params(colors=theme.muted, labelsize=9, length=0)
    bar.outline.set_visible(False)
