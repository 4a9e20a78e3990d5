"""A replay's corrected pose graph as a g2o file."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotavg_ros.datasets.files.corrected_graph import write_corrected_graph
from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.online import Answer
from rotavg_ros.replay.record import RunRecord

# Rotations in a plane have no roll and pitch, and steps no height, beyond rounding.
_PLANAR_TOLERANCE = 1e-9


def write_graph_of_run(path: Path, record: RunRecord) -> None:
    """Write corrected vertices and the edges that are not outliers.

    Args:
        path: of the file.
        record: the run.

    Raises:
        GraphFileError: the file cannot be written.
    """
    answer = record.answer
    position = np.zeros((len(answer.keyframe_id), 3))
    for robot in record.robots:
        if robot.position is not None:
            position[robot.nodes] = np.nan_to_num(robot.position)
    flat = [answer.target_from_source[:, :2], answer.world_from_body[:, :2], np.nan_to_num(answer.translation[:, 2:])]
    ids = keyframe_ids(answer)
    graph_file = GraphFile.from_ids(
        ids[answer.source],
        ids[answer.target],
        answer.target_from_source,
        lone_ids=ids,
        kind=answer.kind,
        precision=answer.precision,
        planar=all(bool((np.abs(values) < _PLANAR_TOLERANCE).all()) for values in flat),
        edge_translation=answer.translation,
        steps=answer.steps,
    )
    order = np.argsort(ids)
    write_corrected_graph(
        path, graph_file, answer.world_from_body[order], position[order], answer.outlier, answer.edge_precision
    )


def keyframe_ids(answer: Answer) -> np.ndarray:
    """``(N,)`` int64: the keyframes' own numbers, or places in the answer where those are too large or not unique."""
    ids = answer.keyframe_id
    usable = len(answer.robots) <= 1 and bool((ids <= np.iinfo(np.int64).max).all())
    return ids.astype(np.int64) if usable else np.arange(len(ids))
