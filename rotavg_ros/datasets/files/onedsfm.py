"""1DSfM view-graphs, ``EGs.txt``: lines ``i j R(9, row-major) t(3)`` without a header.

R is the orientation of camera j in the frame of camera i, that is the transpose of ``R_j R_iᵀ``, and t the position
of camera j in that frame, of unknown scale. Ids are cameras; their order means nothing, so no edge is odometry.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError, writing
from rotavg_ros.datasets.files.text_rows import parse_rows, read_blocks, refuse, write_rows
from rotavg_ros.rotations import from_matrix, inverse, to_matrix

# Largest entry of R Rᵀ - I that still counts as rounding.
_ORTHOGONALITY_TOLERANCE = 1e-2


def read(path: Path) -> GraphFile:
    """Read ``EGs.txt``. Self-edges are skipped and counted.

    Raises:
        GraphFileError: the message names the faulty line.
    """
    ids, numbers = [], []
    for block in read_blocks(path):
        lines, rows = [line for line, _ in block], [row for _, row in block]
        block_ids, block_numbers = parse_rows(path, lines, rows, 2, 12)
        matrix = block_numbers[:, :9].reshape(-1, 3, 3)
        with np.errstate(over="ignore", invalid="ignore"):
            defect = np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2), initial=0)
            is_rotation = (defect <= _ORTHOGONALITY_TOLERANCE) & (np.linalg.det(matrix) > 0)
        refuse(path, lines, ~is_rotation, "the nine numbers after the ids are not a rotation matrix")
        ids.append(block_ids)
        numbers.append(block_numbers)
    all_ids, all_numbers = np.concatenate(ids or [np.empty((0, 2), np.int64)]), np.concatenate(numbers or [np.empty(0)])
    proper = all_ids[:, 0] != all_ids[:, 1]
    if not proper.any():
        raise GraphFileError.at(path, None, "no edges between cameras; there is nothing to solve")
    source_from_target = from_matrix(torch.from_numpy(all_numbers[proper, :9].reshape(-1, 3, 3)))
    return GraphFile.from_ids(
        all_ids[proper, 0],
        all_ids[proper, 1],
        inverse(source_from_target).numpy(),
        lone_ids=all_ids[~proper, 0],
        edge_translation=all_numbers[proper, 9:],
        skipped={} if proper.all() else {"self-edge": int((~proper).sum())},
    )


def write(path: Path, graph_file: GraphFile) -> None:
    """Write ``EGs.txt``. The format cannot store kinds, precisions, stamps or nodes without an edge."""
    graph, ids = graph_file.graph, graph_file.node_ids
    ends = [ids[graph.source.cpu().numpy()], ids[graph.target.cpu().numpy()]]
    matrix = to_matrix(inverse(graph.target_from_source)).cpu().numpy().reshape(-1, 9)
    translation = graph_file.edge_translation
    if translation is None:
        translation = np.zeros((graph.num_edges, 3))
    translation = np.where(np.isfinite(translation).all(axis=1, keepdims=True), translation, 0.0)
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        write_rows(file, f"%d %d{' %.15g' * 12}\n", [*ends, matrix, translation])


def not_stored(graph_file: GraphFile) -> list[str]:
    """The parts of this graph that the format cannot store, in words."""
    graph = graph_file.graph
    joined = np.unique(np.concatenate((graph.source.cpu().numpy(), graph.target.cpu().numpy())))
    lost = {
        "which edges are odometry": bool(graph.is_odometry.any()),
        "precisions": not bool(graph.precision.isnan().all()),
        "nodes without an edge": len(joined) < graph.num_nodes,
        "which translations are unknown (written as 0)": graph.translation is None
        or not bool(graph.translation.isfinite().all()),
    }
    return [name for name, is_lost in lost.items() if is_lost] + graph_file.extras
