"""Corrected poses of a solved file, for `rotavg solve --poses`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotavg_ros.datasets.files.corrected_graph import is_told, write_corrected_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.files.pose_files import write_kitti, write_tum
from rotavg_ros.solver.positions import Translations, fit_positions
from rotavg_ros.solver.solution import Solution

POSE_FILES = ("graph.g2o", "trajectory.kitti", "trajectory.tum")


def pose_files(graph_file: GraphFile) -> list[str]:
    """Names of the files that :func:`write_corrected_poses` writes."""
    return [name for name in POSE_FILES if graph_file.stamps_ns is not None or not name.endswith(".tum")]


def write_corrected_poses(folder: Path, graph_file: GraphFile, solution: Solution) -> None:
    """Write ``graph.g2o``, ``trajectory.kitti``, and ``trajectory.tum`` where the graph has stamps.

    Positions are the answer's, or fitted to the edges' translations where it has none.

    Args:
        folder: where to write them.
        graph_file: N nodes, M edges.
        solution: its answer.

    Raises:
        GraphFileError: a file cannot be written.
    """
    world_from_body, score = solution.world_from_body.cpu().numpy(), solution.outlier_score.cpu().numpy()
    precision = None if solution.edge_precision is None else solution.edge_precision.cpu().numpy()
    judged = None
    if precision is not None and solution.rotation_score is not None:
        judged = solution.rotation_score.cpu().numpy(), precision
    if solution.position is None:
        position = _fitted(graph_file, world_from_body, score)
    else:
        position = solution.position.cpu().numpy()
    told = is_told(score > 0.5, graph_file.graph.is_odometry.cpu().numpy(), judged)
    write_corrected_graph(folder / "graph.g2o", graph_file, world_from_body, position, told, precision)
    write_kitti(folder / "trajectory.kitti", position, world_from_body)
    if graph_file.stamps_ns is not None:
        order = np.argsort(graph_file.stamps_ns, kind="stable")
        write_tum(folder / "trajectory.tum", graph_file.stamps_ns[order], position[order], world_from_body[order])


def _fitted(graph_file: GraphFile, world_from_body: np.ndarray, outlier_score: np.ndarray) -> np.ndarray:
    """``(N, 3)`` metres, fitted with the given orientations."""
    graph = graph_file.graph
    translation = graph_file.edge_translation
    edges = Translations(
        graph.source.cpu().numpy(),
        graph.target.cpu().numpy(),
        np.full((graph.num_edges, 3), np.nan) if translation is None else translation,
        graph.is_odometry.cpu().numpy(),
        outlier_score,
        graph.steps.cpu().numpy(),
    )
    return np.nan_to_num(fit_positions(world_from_body, edges, np.zeros((graph.num_nodes, 3))))
