"""Pictures of a view-graph's noise: histograms of its angles and axes (the paper's Figure 2)."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from matplotlib.colors import LogNorm
from matplotlib.figure import Figure
from matplotlib.projections.geo import GeoAxes
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.evaluation.common.plots import BLUE, INK, MUTED, ORANGE, style
from rotavg_ros.reports.theme import drawable
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import ViewGraph
from rotavg_ros.wording import counted

# Upper ends of the angle axis, each of which puts 10° and 20° on a boundary of its bins.
_ANGLE_RANGES_DEG = (30, 60, 90, 120, 180)
_ANGLE_BINS = 72
_EDGES_PER_CELL = 25
_LATITUDE_CELLS = (8, 24)  # fewest and most, about; twice as many around
_STEPS_PER_CELL = 8  # cells are drawn in steps of latitude, so that they follow the curved outline
_MIN_ANGLE_DEG = 0.01  # below it an axis is only rounding noise


@dataclass(frozen=True)
class EdgeNoise:
    """Noise of M edges, ``R̃_uv = R_uv · noise``, in the source's frame.

    Attributes:
        num_edges: of the graph, those whose noise is unknown included.
        angle_deg: ``(M,)``.
        axis: ``(M, 3)`` unit vectors; NaN where the angle is too small for one.
        is_residual: whether the truth is unknown and the solution was used instead.
    """

    num_edges: int
    angle_deg: np.ndarray
    axis: np.ndarray
    is_residual: bool


def edge_noise(graph: ViewGraph, body_from_world: Tensor | None) -> EdgeNoise:
    """Noise against the truth, or the residual against a solution where the truth is unknown.

    Args:
        body_from_world: ``(N, 4)`` truth; edges of nodes in NaN rows are left out. None: unknown.
    """
    orientations = solve(graph).body_from_world if body_from_world is None else body_from_world.double()
    source, target = orientations[graph.source], orientations[graph.target]
    known = torch.isfinite(source).all(1) & torch.isfinite(target).all(1)
    true_relative = rotations.multiply(target[known], rotations.inverse(source[known]))
    noise = rotations.multiply(rotations.inverse(true_relative), graph.target_from_source[known])
    vector = rotations.log(noise).numpy()
    angle_deg = np.degrees(np.linalg.norm(vector, axis=1))
    with np.errstate(invalid="ignore", divide="ignore"):
        axis = np.where(angle_deg[:, None] > _MIN_ANGLE_DEG, vector / np.radians(angle_deg)[:, None], np.nan)
    return EdgeNoise(graph.num_edges, angle_deg, axis, body_from_world is None)


def draw(path: Path, noise: EdgeNoise, title: str, outlier_angle_deg: float) -> None:
    """Histogram of the angles, and of the axes over the sphere (equal-area, cells of equal area).

    Args:
        outlier_angle_deg: marked in the histogram of the angles.
    """
    figure = Figure(figsize=(13, 4.6), dpi=150, facecolor="white")
    grid = figure.add_gridspec(1, 2, width_ratios=(1, 1.25), left=0.06, right=0.99, top=0.8, bottom=0.14, wspace=0.1)
    figure.text(0.025, 0.94, drawable(title), fontsize=14, fontweight="bold", color=INK, va="center", parse_math=False)
    what = "residuals of the solution; the truth is unknown" if noise.is_residual else "noise against the truth"
    quantiles = np.percentile(noise.angle_deg, (50, 90)) if len(noise.angle_deg) else (np.nan, np.nan)
    outliers = 100 * (noise.angle_deg > outlier_angle_deg).mean() if len(noise.angle_deg) else np.nan
    known = len(noise.angle_deg)
    of_how_many = f"{known} of {noise.num_edges} edges" if known < noise.num_edges else counted(known, "edge")
    subtitle = (
        f"{of_how_many}, {what}   ·   median {quantiles[0]:.3g}°, 90 % below {quantiles[1]:.3g}°   ·   "
        f"{outliers:.1f} % beyond {outlier_angle_deg:g}°"
    )
    figure.text(0.025, 0.885, subtitle, fontsize=10, color=MUTED, va="center")

    angles = figure.add_subplot(grid[0])
    inliers = noise.angle_deg <= outlier_angle_deg
    widest = noise.angle_deg.max(initial=0.0)
    top = next((end for end in _ANGLE_RANGES_DEG if widest <= end), 180)
    angles.hist(
        [noise.angle_deg[inliers], noise.angle_deg[~inliers]],
        bins=np.linspace(0, top, _ANGLE_BINS + 1).tolist(),
        stacked=True,
        color=[BLUE, ORANGE],
        label=[f"up to {outlier_angle_deg:g}°", "beyond"],
        rwidth=0.92,
    )
    angles.set_yscale("log")
    angles.set_xlim(-0.01 * top, 1.01 * top)
    angles.set_xticks(range(0, top + 1, top // 6))
    angles.legend(frameon=False, fontsize=9, labelcolor=INK)
    style(angles, "Angle")
    angles.set_xlabel("degrees", fontsize=9, color=MUTED)
    angles.set_ylabel("edges", fontsize=9, color=MUTED)

    sphere = figure.add_subplot(grid[1], projection="mollweide")
    assert isinstance(sphere, GeoAxes)
    _draw_axes(figure, sphere, noise.axis[np.isfinite(noise.axis).all(1)])
    figure.savefig(path)


def _draw_axes(figure: Figure, sphere: GeoAxes, axis: np.ndarray) -> None:
    # The y axis, the cameras' vertical, is up; straight ahead, along z, is the middle.
    longitude = np.arctan2(axis[:, 0], axis[:, 2])
    # Bins of equal width in longitude and in the sine of latitude are cells of equal area.
    cells = int(np.clip(np.sqrt(len(axis) / (2 * _EDGES_PER_CELL)), *_LATITUDE_CELLS))
    # Odd numbers, so that the axis of a planar graph lies in the middle of a cell and not in a corner of four.
    cells, around = cells | 1, 2 * cells | 1
    counts, longitudes, heights = np.histogram2d(
        longitude, axis[:, 1], bins=(around, cells), range=((-np.pi, np.pi), (-1.0, 1.0))
    )
    density = counts / max(counts.mean(), np.finfo(float).tiny)
    boundaries = np.arcsin(heights)
    latitudes = np.interp(np.linspace(0, cells, cells * _STEPS_PER_CELL + 1), np.arange(cells + 1), boundaries)
    mesh = sphere.pcolormesh(
        longitudes,
        latitudes,
        np.ma.masked_equal(np.repeat(density.T, _STEPS_PER_CELL, axis=0), 0),
        norm=LogNorm(0.1, max(float(density.max(initial=1.0)), 10.0)),
        cmap="viridis",
        rasterized=True,
    )
    style(sphere, "")
    sphere.set_title("Axis in the source's frame (up: y, middle: z, a quarter to the right: x)", fontsize=11, color=INK)
    sphere.set_xticklabels([])
    sphere.set_yticklabels([])
    bar = figure.colorbar(mesh, ax=sphere, shrink=0.8, pad=0.02)
    bar.set_label("times the density of uniform axes", fontsize=9, color=MUTED)
    bar.ax.tick_params(labelsize=9, colors=MUTED)
    bar.outline.set_visible(False)
