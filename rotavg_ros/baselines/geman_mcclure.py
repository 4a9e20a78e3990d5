"""Geman–McClure rotation averaging: ℓ1, then iteratively reweighted least squares with a redescending loss.

The loss ρ(r) = σ² r² / (2 (σ² + r²)) (Geman & McClure 1987) is square far below σ and constant far above it, so that
what is clearly wrong does not pull at all. Its weight is w(r) = (σ² / (σ² + r²))². Chatterjee & Govindu (ICCV 2013,
TPAMI 2018) begin it at the ℓ1 answer, since it has many minima; so do Theia, GLOMAP and COLMAP, whose σ of 5° this
takes. It is the reference for COLMAP's figures that COLMAP's own conventions and precision have no part in: all is in
float64 and goes on until it has converged.

On SLAM graphs that state precisions, residuals count in stated standard deviations and σ is three of them.

Warm start: in place of the spanning tree's orientations; both stages run.
"""

from __future__ import annotations

import numpy as np
from torch import Tensor

from rotavg_ros.baselines.chatterjee import Stage, minimize_l1, reweighted, units
from rotavg_ros.baselines.start import start_orientations, usable_edges
from rotavg_ros.view_graph import ViewGraph

SCALE = float(np.radians(5.0))
_SLAM_SCALE = 3.0
_STAGE = Stage(max_steps=200, converged_step=1e-6)
# Weights count as at least this, so that a node all of whose edges are far off stays where they put it.
_LEAST_WEIGHT = 1e-9


def geman_mcclure(graph: ViewGraph, start: Tensor | None = None) -> Tensor:
    """ℓ1 → Geman–McClure orientations, body_from_world ``(N, 4)`` float64; noise-free graphs to rounding.

    Args:
        start: body_from_world ``(N, 4)``; default: composed along a spanning tree.
    """
    graph = usable_edges(graph)
    orientations, roots = start_orientations(graph, start)
    precision, scale = units(graph, SCALE, _SLAM_SCALE)

    def weigh(square: np.ndarray) -> np.ndarray:
        return np.asarray(precision * np.maximum((1 + precision * square / scale**2) ** -2, _LEAST_WEIGHT))

    return reweighted(graph, minimize_l1(graph, orientations, roots), roots, weigh, _STAGE)
