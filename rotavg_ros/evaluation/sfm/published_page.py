"""The paper's own figures as a page, with what can be measured here and where."""

from __future__ import annotations

from collections.abc import Mapping

from rotavg_ros.evaluation.common.tables import Cell, Column, Table
from rotavg_ros.evaluation.sfm.published import GPU_SECONDS, REAL, ROBUSTNESS, SCANNET, SYNTHETIC, Published
from rotavg_ros.evaluation.sfm.synthetic import ROWS

_INTRODUCTION = f"""\
What the paper publishes (Purkait, Chin & Reid, *NeuRoRA: Neural Robust Rotation Averaging*, ECCV 2020), as printed:
degrees and seconds, its graphs, its machine. Ours are on other pages: [synthetic graphs](synthetic-paper.md) and
[robustness](robustness.md) have the two side by side, [real graphs](real.md) and [scans](rgbd.md) have what data we
had. Our generator follows the paper's text, which disagrees with its released scripts, so its graphs may be easier or
harder; compare ratios rather than degrees. On a GPU the paper states {GPU_SECONDS[0]} s for a synthetic graph and
{GPU_SECONDS[1]} s for the ScanNet one; none was at hand here.
"""


def page() -> str:
    """Markdown."""
    tables = (_methods("Table 1: synthetic", SYNTHETIC), _real(), _robustness(), _methods("Table 4: ScanNet", SCANNET))
    return "# The paper's figures\n\n" + _INTRODUCTION + "\n" + "\n".join(table.to_markdown() for table in tables)


def _methods(title: str, figures: Mapping[str, Published]) -> Table:
    headings = (Column("method"), Column("mean °", ".2f"), Column("median °", ".2f"), Column("CPU s", ".2f"))
    return Table(title, headings, tuple((ROWS.get(name, name), *row) for name, row in figures.items()))


def _real() -> Table:
    methods = tuple(next(iter(REAL.values())).figures)
    errors = (Column(f"{ROWS.get(name, name)}: mean ° / median ° / s") for name in methods)
    headings = (Column("scene"), Column("cameras"), Column("with truth"), Column("pairs %", ".1f"), *errors)
    rows: list[tuple[Cell, ...]] = []
    for name, scene in REAL.items():
        of_methods = (_together(scene.figures[method]) for method in methods)
        rows.append((name, scene.cameras, scene.with_truth, scene.pairs_percent, *of_methods))
    return Table("Table 2: photo collections", headings, tuple(rows), ("Errors are over cameras with ground truth.",))


def _robustness() -> Table:
    headings = (
        Column("what varies"),
        Column("trained on"),
        Column("tested on"),
        Column("NeuRoRA: mean ° / median ° / s"),
        Column(f"{ROWS['chatterjee']}: mean ° / median ° / s"),
    )
    rows: tuple[tuple[Cell, ...], ...] = tuple(
        (
            each.varied,
            str(each.trained),
            str(each.tested),
            _together(each.neurora),
            "" if each.chatterjee is None else _together(each.chatterjee),
        )
        for each in ROBUSTNESS
    )
    note = "Cameras, share of the pairs, σ at most, outliers. The paper has no figure where it is empty."
    return Table("Table 3: robustness", headings, rows, (note,))


def _together(figures: Published) -> str:
    return f"{figures.mean_deg:g} / {figures.median_deg:g} / {figures.cpu_seconds:g}"
