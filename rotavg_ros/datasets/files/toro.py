"""TORO's pose graphs: written here; :mod:`rotavg_ros.datasets.files.g2o` reads them and all related formats."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.g2o import EDGE_TAGS, not_stored
from rotavg_ros.datasets.files.graph_file import GraphFile, writing
from rotavg_ros.datasets.files.pose_graph_rows import lay_out
from rotavg_ros.datasets.files.text_rows import write_rows

__all__ = ["not_stored", "write"]


def write(path: Path, graph_file: GraphFile) -> None:
    """Write VERTEX2 and EDGE2, or VERTEX3 and EDGE3 lines; otherwise as :func:`rotavg_ros.datasets.files.g2o.write`.

    Raises:
        GraphFileError: the place cannot be written.
    """
    poses = lay_out(graph_file)
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        if graph_file.planar:
            write_rows(file, f"VERTEX2 %d{' %.15g' * 3}\n", [poses.ids, *poses.planar_vertices])
            information = poses.information[:, EDGE_TAGS[b"EDGE2"].information]
            write_rows(file, f"EDGE2 %d %d{' %.15g' * 9}\n", [*poses.ends, *poses.planar_edges, information])
        else:
            vertices = [poses.ids, poses.position, _roll_pitch_yaw(poses.world_from_body)]
            write_rows(file, f"VERTEX3 %d{' %.15g' * 6}\n", vertices)
            edges = [*poses.ends, poses.translation, _roll_pitch_yaw(poses.source_from_target), poses.information]
            write_rows(file, f"EDGE3 %d %d{' %.15g' * 27}\n", edges)


def _roll_pitch_yaw(quaternions: np.ndarray) -> np.ndarray:
    """``(K, 3)`` radians; the roll is 0 where a pitch of ±90° leaves it undetermined."""
    return np.asarray(Rotation.from_quat(quaternions).as_euler("xyz", suppress_warnings=True))
