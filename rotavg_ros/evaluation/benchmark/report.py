"""Tables and pictures of the benchmark."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

from rotavg_ros.evaluation.benchmark.measure import LABELS, OURS, Measurement
from rotavg_ros.evaluation.benchmark.plans import FAMILIES
from rotavg_ros.evaluation.benchmark.schedule import NO_GPU, Result
from rotavg_ros.evaluation.common.plots import MUTED, PALETTE, style
from rotavg_ros.evaluation.common.tables import Cell, Column, Table

_REFERENCE = "neurora"
# On an axis that spans less than this factor, 2 and 5 are labelled, too.
_FEW_DECADES = 100
_COLUMNS = (
    Column("nodes"),
    Column("edges"),
    Column("solver"),
    Column("solves"),
    Column("s", ".3f"),
    Column("fastest", ".3f"),
    Column("slowest", ".3f"),
    Column("CPU s", ".3f"),
    Column("CPU s ÷ rotavg's", ".1f"),
    Column("mean error °", ".2f"),
    Column("median °", ".2f"),
    Column("peak MB", ".0f"),
    Column("of it before MB", ".0f"),
)


def time_table(family: str, results: Sequence[Result]) -> Table:
    """Every measurement of a family; medians over the repeats."""
    rows = []
    for result in results:
        reference = result.measured.get(_REFERENCE)
        for contender, measured in result.measured.items():
            ratio = None if reference is None else _cpu(measured) / _cpu(reference)
            rows.append(_row(contender, measured, ratio))
    return Table(FAMILIES[family].title, _COLUMNS, tuple(rows), _missing(results))


def summary(results: Mapping[str, Sequence[Result]]) -> list[str]:
    """How we compare with every peer, in words: on the largest graph that both solved, and where the peer is ahead."""
    lines = []
    for family, of_family in results.items():
        title = FAMILIES[family].title.partition(":")[0]
        for peer in FAMILIES[family].contenders:
            both = [one.measured for one in of_family if _REFERENCE in one.measured and peer in one.measured]
            if peer not in OURS and both:
                lines.append(_against(title, peer, [(one[_REFERENCE], one[peer]) for one in both]))
    return lines


def _against(title: str, peer: str, pairs: Sequence[tuple[Measurement, Measurement]]) -> str:
    """One line; pairs are our measurement and the peer's."""
    ours, theirs = max(pairs, key=lambda pair: pair[0].edges)
    cpu, wall = _cpu(theirs) / _cpu(ours), _wall(theirs) / _wall(ours)
    line = (
        f"{title}, {LABELS[peer]}: on the largest graph that both solved ({ours.nodes} nodes, {ours.edges} edges) it "
        f"takes {cpu:.1f} times rotavg's CPU time and {wall:.1f} times its wall-clock time, for a mean error of "
        f"{theirs.mean_deg:.2f}° (rotavg {ours.mean_deg:.2f}°)"
    )
    faster = [f"{ours.edges} edges" for ours, theirs in pairs if _cpu(theirs) < _cpu(ours)]
    better = [f"{ours.edges} edges" for ours, theirs in pairs if theirs.mean_deg < ours.mean_deg]
    losses = [f"{what} at {', '.join(where)}" for what, where in (("faster", faster), ("more exact", better)) if where]
    return f"{line}; it is {' and '.join(losses)}." if losses else f"{line}; nowhere is it faster or more exact."


def recipe_table(results: Sequence[Result]) -> Table:
    """Averages over the graphs of the paper's recipe that every contender has solved."""
    title = f"{FAMILIES['recipe'].title}, averages over {len(results)} graphs"
    names = [name for name in FAMILIES["recipe"].contenders if all(name in result.measured for result in results)]
    columns = [
        Column("solver"),
        Column("s", ".3f"),
        Column("CPU s", ".3f"),
        Column("mean °", ".2f"),
        Column("median °", ".2f"),
    ]
    rows: list[tuple[Cell, ...]] = []
    for name in names if results else []:
        of_name = [result.measured[name] for result in results]
        averages = [
            float(np.mean([value(one) for one in of_name])) for value in (_wall, _cpu, _mean_error, _median_error)
        ]
        rows.append((LABELS[name], *averages))
    return Table(title, tuple(columns), tuple(rows), _missing(results))


def stage_table(results: Mapping[str, Sequence[Result]]) -> Table:
    """Our own stages on the largest graph of every family."""
    rows: list[tuple[Cell, ...]] = []
    for of_family in results.values():
        solved = [result.measured[_REFERENCE] for result in of_family if _REFERENCE in result.measured]
        if solved:
            largest = max(solved, key=lambda one: one.edges)
            size = f"{largest.nodes} nodes, {largest.edges} edges"
            rows += [(size, stage, seconds) for stage, seconds in largest.stage_seconds.items()]
    return Table("Our stages", (Column("graph"), Column("stage"), Column("s", ".3f")), tuple(rows))


def draw_scaling(path: Path, results: Mapping[str, Sequence[Result]]) -> None:
    """CPU seconds, error and memory over the number of edges, a row of pictures per family."""
    families = [name for name in results if name != "recipe" and results[name]]
    figure = Figure(figsize=(14, 1 + 3.6 * max(len(families), 1)), dpi=130, facecolor="white", layout="constrained")
    if families:
        rows = figure.subplots(len(families), 3, squeeze=False)
        for row, family in zip(rows, families, strict=True):
            title = FAMILIES[family].title.partition(":")[0]
            _draw(row[0], results[family], _cpu, f"{title}: CPU seconds")
            _draw(row[1], results[family], _mean_error, "mean error, degrees")
            _draw(row[2], results[family], lambda one: one.peak_bytes / 1e6, "peak memory of the process, MB")
        handles = {
            label: handle for axes in rows.flat for handle, label in zip(*axes.get_legend_handles_labels(), strict=True)
        }
        figure.legend(
            handles.values(), handles.keys(), loc="outside upper left", ncols=len(handles), frameon=False, fontsize=9
        )
    figure.savefig(path)


def _draw(axes: Axes, results: Sequence[Result], value: Callable[[Measurement], float], title: str) -> None:
    contenders = dict.fromkeys(name for result in results for name in result.measured)
    for name in contenders:
        points = [result.measured[name] for result in results if name in result.measured]
        colour = PALETTE[list(LABELS).index(name) % len(PALETTE)]
        edges = [point.edges for point in points]
        axes.plot(edges, [value(point) for point in points], "o-", color=colour, markersize=4, label=LABELS[name])
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.xaxis.set_minor_formatter(NullFormatter())  # on less than a decade they would overlap
    low, high = axes.get_ylim()
    if high < _FEW_DECADES * low:
        axes.yaxis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axes.yaxis.set_minor_formatter(NullFormatter())
    axes.yaxis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:g}"))
    axes.set_xlabel("edges", fontsize=9, color=MUTED)
    style(axes, title)


def _row(contender: str, measured: Measurement, ratio: float | None) -> tuple[Cell, ...]:
    return (
        measured.nodes,
        measured.edges,
        LABELS[contender],
        len(measured.wall_seconds),
        _wall(measured),
        min(measured.wall_seconds),
        max(measured.wall_seconds),
        _cpu(measured),
        ratio,
        measured.mean_deg,
        measured.median_deg,
        measured.peak_bytes / 1e6,
        measured.graph_bytes / 1e6,
    )


def _missing(results: Sequence[Result]) -> tuple[str, ...]:
    """Notes on contenders without a row, and why."""
    reasons: dict[str, list[str]] = {}
    for result in results:
        for contender, reason in result.missing.items():
            where = (
                "" if reason == NO_GPU else f"{result.plan.nodes} nodes and about {result.plan.expected_edges} edges: "
            )
            reasons.setdefault(contender, []).append(where + reason)
    return tuple(f"{LABELS[name]}: {'; '.join(dict.fromkeys(of_name))}." for name, of_name in reasons.items())


def _wall(measured: Measurement) -> float:
    return float(np.median(measured.wall_seconds))


def _cpu(measured: Measurement) -> float:
    return float(np.median(measured.cpu_seconds))


def _mean_error(measured: Measurement) -> float:
    return measured.mean_deg


def _median_error(measured: Measurement) -> float:
    return measured.median_deg
