"""A replay's corrected pose graph as a g2o file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.datasets.files.corrected_graph import is_told, write_corrected_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.planar import are_about_z, are_level
from rotavg_ros.online import Answer
from rotavg_ros.replay.record import RunRecord
from rotavg_ros.solver.positions import Translations, fit_positions
from rotavg_ros.view_graph import EdgeKind

# Ids of one robot that span more than this are replaced by consecutive numbers, so that ids of several robots fit.
_MOST_BETWEEN = 1 << 40


def write_graph_of_run(path: Path, record: RunRecord) -> None:
    """Write the corrected vertices and the edges that are believed.

    Args:
        path: of the file.
        record: the run.

    Raises:
        GraphFileError: the file cannot be written.
    """
    answer = record.answer
    position = np.nan_to_num(_positions(record))
    turns = np.concatenate((answer.target_from_source, answer.world_from_body))
    is_flat = are_level(answer.translation)
    ids = keyframe_ids(answer)
    graph_file = GraphFile.from_ids(
        ids[answer.source],
        ids[answer.target],
        answer.target_from_source,
        lone_ids=ids,
        kind=answer.kind,
        precision=answer.precision,
        planar=is_flat and are_about_z(turns),
        edge_translation=answer.translation,
        steps=answer.steps,
    )
    order = np.argsort(ids)
    precision = answer.edge_precision
    judged = None if precision is None or answer.rotation_score is None else (answer.rotation_score, precision)
    told = is_told(answer.outlier, answer.kind == EdgeKind.ODOMETRY, judged)
    write_corrected_graph(path, graph_file, answer.world_from_body[order], position[order], told, precision)


def _positions(record: RunRecord) -> NDArray[np.float64]:
    """``(N, 3)`` metres, NaN where unknown: those of the trajectories; of keyframes without stamps, in none, fitted."""
    answer = record.answer
    position = np.full((len(answer.keyframe_id), 3), np.nan)
    for robot in record.robots:
        if robot.position is not None:
            position[robot.nodes] = robot.position
    placed = np.isfinite(position).all(axis=1)
    if placed.all():
        return position
    fitted = answer.position
    if fitted is None:
        edges = Translations(
            answer.source,
            answer.target,
            answer.translation,
            answer.kind == EdgeKind.ODOMETRY,
            np.where(answer.outlier, 1.0, answer.outlier_score),
            answer.steps,
        )
        fitted = fit_positions(answer.world_from_body, edges, position)
    # A component is one rigid map: its placed keyframes tell where its others are.
    for component in np.unique(answer.component[~placed]):
        members = answer.component == component
        both = members & placed & np.isfinite(fitted).all(axis=1)
        shift = np.median(position[both] - fitted[both], axis=0) if both.any() else np.zeros(3)
        position[members & ~placed] = fitted[members & ~placed] + shift
    return position


def keyframe_ids(answer: Answer) -> np.ndarray:
    """``(N,)`` int64: the own ids of a single robot; for several robots, or too large ids, they count from 0.

    The robots' ranges follow each other with a gap of one, and ids within a range differ as the robot's own do. To
    readers without kinds of edges, an edge between consecutive ids is odometry.
    """
    ids = answer.keyframe_id
    largest = np.iinfo(np.int64).max
    if len(answer.robots) <= 1 and bool((ids <= largest).all()):
        return ids.astype(np.int64)
    numbers, begin = np.empty(len(ids), dtype=np.int64), 0
    for robot in range(len(answer.robots)):
        nodes = answer.keyframe_robot == robot
        if not nodes.any():
            continue
        own = ids[nodes] - ids[nodes].min()
        if own.max() > _MOST_BETWEEN:
            own = np.argsort(np.argsort(own))
        numbers[nodes] = begin + own.astype(np.int64)
        begin += int(own.max()) + 2
    return numbers
