"""Pairwise registrations of RGB-D scans: an npz view-graph with ground truth and a residual per registration."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.formats import read_graph
from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError


@dataclass(frozen=True)
class RgbdScene:
    """A scene of N scans and M registrations.

    Attributes:
        graph_file: the view-graph with ground truth. Edges that state no precision have that of a registration whose
            points lie 1 m from its centre, rms⁻² rad⁻²: only the differences matter, not the scale. Failed ones get the
            worst precision of the others.
        registration_rms: ``(M,)`` metres, the root mean square distance of matched points; inf where it failed.
    """

    graph_file: GraphFile
    registration_rms: np.ndarray


# The registrations' own mark of failure, in metres.
_FAILED_RMS = 1e6


def read_scene(path: str | Path) -> RgbdScene:
    """Read a scene.

    Raises:
        GraphFileError: no readable view-graph, or one without ground truth or ``registration_rms``.
    """
    path = Path(path)
    graph_file = read_graph(path)
    if graph_file.body_from_world_gt is None:
        raise GraphFileError.at(path, None, "lacks body_from_world_gt; an RGB-D scene has ground truth")
    with np.load(path, allow_pickle=False) as archive:
        if "registration_rms" not in archive.files:
            raise GraphFileError.at(path, None, "lacks registration_rms; an RGB-D scene has one per edge")
        rms = archive["registration_rms"].astype(np.float64)
        proper = archive["source"] != archive["target"]  # self-edges are not part of the graph
    if rms.shape != proper.shape:
        raise GraphFileError.at(path, None, f"registration_rms has shape {rms.shape}, source has {proper.shape}")
    rms = np.where(rms < _FAILED_RMS, rms, np.inf)[proper]
    return RgbdScene(_with_precisions(graph_file, rms), rms)


def _with_precisions(graph_file: GraphFile, rms: np.ndarray) -> GraphFile:
    graph, is_known = graph_file.graph, np.isfinite(rms) & (rms > 0)
    if bool(graph.precision.isfinite().any()) or not is_known.any():
        return graph_file
    of_edge = np.where(is_known, rms, rms[is_known].max())
    return replace(graph_file, graph=replace(graph, precision=torch.from_numpy(of_edge**-2)))
