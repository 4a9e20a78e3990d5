"""A solved pose graph in g2o: corrected vertices, and the edges that are believed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files import g2o
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.pose_graph_rows import (
    ANGULAR_DIAGONAL,
    NO_INFORMATION,
    POSITION_DIAGONAL,
    rotation_information,
)

# A closure whose rotation is more likely wrong than right is left out.
_FALSE = 0.5


def is_told(outlier: np.ndarray, is_odometry: np.ndarray, judged: tuple[np.ndarray, np.ndarray] | None) -> np.ndarray:
    """``(M,)`` bool, edges that are safe for plain least squares: no outliers.

    Where precisions were estimated, these state how far each edge is believed. Then closures with a right rotation that
    join the wrong place are kept for their rotation, and odometry that slipped or jumped still joins its ends.

    Args:
        outlier: ``(M,)`` bool.
        is_odometry: ``(M,)`` bool.
        judged: ``(M,)`` probabilities that rotations are wrong, and ``(M, 2)`` precisions; None: not estimated.
    """
    if judged is None:
        return ~outlier
    rotation_score, precision = judged
    return np.asarray((is_odometry | (rotation_score <= _FALSE)) & (precision > 0).any(axis=1))


def write_corrected_graph(
    path: Path,
    graph_file: GraphFile,
    world_from_body: np.ndarray,
    position: np.ndarray,
    told: np.ndarray,
    precision: np.ndarray | None = None,
) -> None:
    """Write corrected vertices and some edges, so that plain least squares can continue from there.

    Unknown precisions become a typical known one, since the format cannot express unknown ones; for a merged odometry
    edge, it is divided by the number of steps.

    Args:
        path: of the g2o file.
        graph_file: N nodes, M edges; translations that are NaN are not known.
        world_from_body, position: ``(N, 4)`` xyzw and ``(N, 3)`` metres.
        told: ``(M,)`` bool, the edges to write (:func:`is_told`).
        precision: ``(M, 2)`` estimated, rad⁻² and m⁻² per component; default: as stated by the edges.

    Raises:
        GraphFileError: the file cannot be written.
    """
    kept = np.flatnonzero(told)
    graph = graph_file.graph.select_edges(torch.from_numpy(kept).to(graph_file.graph.device))
    translation = graph_file.edge_translation
    translation = np.full((len(kept), 3), np.nan) if translation is None else translation[kept]
    stated = graph_file.edge_information if precision is None else _isotropic(precision)
    information = np.zeros((len(kept), 21)) if stated is None else stated[kept]
    unstated = ~np.any(information, axis=1, keepdims=True)
    known = np.isfinite(translation).all(axis=1)
    precision = graph.precision.cpu().numpy()
    typical = np.nanmedian(precision) if np.isfinite(precision).any() else 1.0
    typical = typical / graph.steps.cpu().numpy()
    defaults = rotation_information(graph, np.where(np.isnan(precision), typical, precision))
    defaults[:, POSITION_DIAGONAL] = np.where(known, 1.0, NO_INFORMATION)[:, None]
    chosen = replace(
        graph_file,
        graph=graph,
        edge_translation=translation,
        edge_information=np.where(unstated, defaults, information),
    )
    g2o.write(path, chosen, world_from_body * [-1.0, -1.0, -1.0, 1.0], position)


def _isotropic(precision: np.ndarray) -> np.ndarray:
    """``(M, 21)`` information of edges whose errors are isotropic."""
    information = np.zeros((len(precision), 21))
    information[:, ANGULAR_DIAGONAL] = precision[:, [0]]
    information[:, POSITION_DIAGONAL] = np.maximum(precision[:, [1]], NO_INFORMATION)
    return information
