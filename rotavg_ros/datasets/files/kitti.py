"""KITTI's pose files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFileError
from rotavg_ros.datasets.files.text_rows import parse_rows, read_blocks, refuse

# Largest deviation of a pose file's matrix from a rotation.
_ORTHOGONALITY_TOLERANCE = 1e-3


def read_poses(path: str | Path) -> tuple[Rotation, np.ndarray]:
    """Poses of a file with a row-major 3 × 4 matrix ``[R | t]``, world from camera, per line.

    Returns:
        N rotations world_from_camera, and ``(N, 3)`` positions in the world frame, metres.

    Raises:
        GraphFileError: a malformed line, or a matrix that is not a rotation.
    """
    path = Path(path)
    rows = [row for block in read_blocks(path) for row in block]
    lines = [line for line, _ in rows]
    if not rows:
        raise GraphFileError.at(path, None, "the file is empty; expected a 3 × 4 pose matrix per line")
    _, numbers = parse_rows(path, lines, [row for _, row in rows], 0, 12)
    poses = numbers.reshape(-1, 3, 4)
    matrix, position = poses[:, :, :3], poses[:, :, 3]
    deviation = np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
    no_rotation = (deviation > _ORTHOGONALITY_TOLERANCE) | (np.linalg.det(matrix) < 0)
    refuse(path, lines, no_rotation, "a matrix that is not a rotation; expected row-major [R | t]")
    return Rotation.from_matrix(matrix), position
