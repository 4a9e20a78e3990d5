"""The corrected pose graph as a g2o file, from which plain least squares can go on."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets import g2o
from rotavg_ros.datasets.graph_file import GraphFile
from rotavg_ros.datasets.pose_graph_rows import ANGULAR_DIAGONAL, POSITION_DIAGONAL
from rotavg_ros.online import Answer
from rotavg_ros.online.growing_view_graph import GraphSnapshot
from rotavg_ros.replay.record import RunRecord

# Rotations in a plane have no roll and pitch, and steps no height, beyond rounding.
_PLANAR_TOLERANCE = 1e-9
# Of a position that is not known: as good as none, but the matrix can still be inverted.
_NO_INFORMATION = 1e-9


def write_corrected_graph(path: Path, record: RunRecord, snapshot: GraphSnapshot) -> None:
    """Write corrected vertices and the edges that are not outliers.

    Args:
        path: of the file.
        record: the run.
        snapshot: the graph of its answer, or a later one.

    Raises:
        GraphFileError: the file cannot be written.
    """
    answer = record.answer
    kept = np.flatnonzero(~answer.outlier)
    graph = snapshot.graph.select_edges(torch.from_numpy(kept))
    translation = snapshot.translation[kept]
    precision = graph.precision.nan_to_num(1.0).numpy()
    information = np.zeros((len(kept), 21))
    information[:, ANGULAR_DIAGONAL] = precision[:, None]
    known = np.isfinite(translation).all(axis=1)
    information[:, POSITION_DIAGONAL] = np.where(known, 1.0, _NO_INFORMATION)[:, None]
    position = np.zeros((len(answer.keyframe_id), 3))
    for robot in record.robots:
        if robot.position is not None:
            position[robot.nodes] = np.nan_to_num(robot.position)
    ids = keyframe_ids(answer)
    planar = _is_planar(graph.target_from_source.numpy(), answer.world_from_body) and not np.any(
        np.abs(np.nan_to_num(translation[:, 2])) > _PLANAR_TOLERANCE
    )
    graph_file = GraphFile.from_ids(
        ids[graph.source.numpy()],
        ids[graph.target.numpy()],
        graph.target_from_source.numpy(),
        lone_ids=ids,
        kind=graph.kind.numpy(),
        precision=precision,
        planar=bool(planar),
        edge_translation=np.nan_to_num(translation),
        edge_information=information,
    )
    order = np.argsort(ids)
    body_from_world = answer.world_from_body[order] * [-1.0, -1.0, -1.0, 1.0]
    g2o.write(path, graph_file, body_from_world, position[order])


def keyframe_ids(answer: Answer) -> np.ndarray:
    """``(N,)`` int64: the keyframes' own numbers, or places in the answer where those are too large or not unique."""
    ids = answer.keyframe_id
    usable = len(answer.robots) <= 1 and bool((ids <= np.iinfo(np.int64).max).all())
    return ids.astype(np.int64) if usable else np.arange(len(ids))


def _is_planar(*quaternions: np.ndarray) -> bool:
    return all(bool((np.abs(rotation[:, :2]) < _PLANAR_TOLERANCE).all()) for rotation in quaternions)
