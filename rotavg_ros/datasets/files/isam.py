"""iSAM's pose graphs in the plane: written here; :mod:`rotavg_ros.datasets.files.g2o` reads them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotavg_ros.datasets.files import g2o
from rotavg_ros.datasets.files.g2o import EDGE_TAGS
from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError, writing
from rotavg_ros.datasets.files.pose_graph_rows import lay_out
from rotavg_ros.datasets.files.text_rows import write_rows


def write(path: Path, graph_file: GraphFile) -> None:
    """Write ODOMETRY lines, which carry the upper triangular root of the information matrix. iSAM has no vertices.

    Raises:
        GraphFileError: a graph that is not planar, information without a root, or a place that cannot be written.
    """
    if not graph_file.planar:
        raise GraphFileError.at(path, None, "iSAM's format is for graphs in the plane; write .toro or .g2o")
    poses = lay_out(graph_file)
    xx, xy, xt, yy, yt, tt = poses.information[:, EDGE_TAGS[b"EDGE_SE2"].information].T
    matrix = np.stack((xx, xy, xt, xy, yy, yt, xt, yt, tt), axis=1).reshape(-1, 3, 3)
    try:
        root = np.linalg.cholesky(matrix).transpose(0, 2, 1)
    except np.linalg.LinAlgError:
        what = "an edge's information matrix is not positive definite, so it has no root; write .toro or .g2o"
        raise GraphFileError.at(path, None, what) from None
    row, column = np.triu_indices(3)
    with writing(path) as temporary, temporary.open("w", encoding="ascii") as file:
        write_rows(file, f"ODOMETRY %d %d{' %.15g' * 9}\n", [*poses.ends, *poses.planar_edges, root[:, row, column]])


def not_stored(graph_file: GraphFile) -> list[str]:
    """The parts of this graph that the format cannot store, in words."""
    graph = graph_file.graph
    touched = np.union1d(graph.source.cpu().numpy(), graph.target.cpu().numpy())
    alone = ["nodes without an edge"] if len(touched) < graph.num_nodes else []
    return g2o.not_stored(graph_file) + alone
