"""View-graphs of the Lund data sets with ground truth, as MATLAB files (Olsson & Enqvist's scenes).

For N cameras: ``Rgt`` ``(3N, 3)``, the stacked true R_i; ``Rrel`` ``(3N, 3N)``, whose 3 × 3 block (i, j), i < j, is the
measured ``R_j R_iᵀ`` or zero where there is none; optionally ``H`` ``(3N, 3N)``, whose blocks are the Hessians of the
two-view problems in the rotation, of unknown scale. Ids are 0 … N-1, and no edge is odometry.

The files do not say in whose frame a Hessian is, but the errors of the Sphinx do: by Student's t with one degree of
freedom, their log-likelihood is 990 nats higher with Hessians in the frame of camera j, the target, than in that of i.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.files.graph_file import GraphFile, GraphFileError, reading
from rotavg_ros.rotations import from_matrix

# Largest entry of R Rᵀ - I that still counts as rounding.
_ORTHOGONALITY_TOLERANCE = 1e-3


def read(path: Path) -> GraphFile:
    """Read a Lund file; a Hessian becomes the rotation part of the edge's information.

    Raises:
        GraphFileError: the message names the faulty array.
    """
    arrays = _load(path)
    truth = arrays["Rgt"]
    num_nodes = len(truth) // 3
    if truth.shape != (3 * num_nodes, 3) or num_nodes < 2:
        raise GraphFileError.at(path, None, f"Rgt has shape {truth.shape}; it must be (3 N, 3) of N cameras")
    for name in ("Rrel", "H"):
        if name in arrays and arrays[name].shape != (3 * num_nodes, 3 * num_nodes):
            needed = f"it must be ({3 * num_nodes}, {3 * num_nodes}) to fit Rgt"
            raise GraphFileError.at(path, None, f"{name} has shape {arrays[name].shape}; {needed}")
    relative = _blocks(arrays["Rrel"])
    source, target = np.nonzero(np.triu((relative != 0).any(axis=(2, 3)), k=1))
    if len(source) == 0:
        raise GraphFileError.at(path, None, "no edges in the upper triangle of Rrel; there is nothing to solve")
    hessian = _blocks(arrays["H"])[source, target] if "H" in arrays else None
    graph_file = GraphFile.from_ids(
        source,
        target,
        _quaternions(path, "Rrel", relative[source, target]),
        lone_ids=np.arange(num_nodes),
        edge_information=None if hessian is None else _information(hessian),
        information=hessian,
    )
    return replace(graph_file, body_from_world_gt=_quaternions(path, "Rgt", truth.reshape(-1, 3, 3)))


def _load(path: Path) -> dict[str, np.ndarray]:
    from scipy.io import loadmat

    with reading(path):
        file = path.open("rb")
    try:
        with file:
            content = loadmat(file, variable_names=("Rgt", "Rrel", "H"))
    except Exception as error:  # a damaged file can fail anywhere in the decoder
        reason = " ".join(str(error).split())[:120] or type(error).__name__
        raise GraphFileError.at(path, None, f"not a readable MATLAB file (version 7 or older): {reason}") from None
    missing = [name for name in ("Rgt", "Rrel") if name not in content]
    if missing:
        raise GraphFileError.at(path, None, f"lacks {', '.join(missing)}; a Lund view-graph has Rgt and Rrel")
    try:
        return {name: np.array(content[name], dtype=np.float64) for name in ("Rgt", "Rrel", "H") if name in content}
    except (TypeError, ValueError):
        raise GraphFileError.at(path, None, "Rgt, Rrel and H must be plain arrays of numbers") from None


def _blocks(matrix: np.ndarray) -> np.ndarray:
    """``(3N, 3N)`` as ``(N, N, 3, 3)``."""
    num_nodes = len(matrix) // 3
    return np.asarray(matrix.reshape(num_nodes, 3, num_nodes, 3).transpose(0, 2, 1, 3))


def _quaternions(path: Path, name: str, matrix: np.ndarray) -> np.ndarray:
    with np.errstate(over="ignore", invalid="ignore"):
        defect = np.abs(matrix @ matrix.transpose(0, 2, 1) - np.eye(3)).max(axis=(1, 2))
        is_rotation = (defect <= _ORTHOGONALITY_TOLERANCE) & (np.linalg.det(matrix) > 0)
    if not is_rotation.all():
        raise GraphFileError.at(path, None, f"{name} has a block that is not a rotation matrix")
    return from_matrix(torch.from_numpy(matrix)).numpy()


def _information(hessian: np.ndarray) -> np.ndarray:
    """``(M, 21)``: zeros for the translation, and the Hessian's upper triangle, if it is finite, for the rotation."""
    hessian = np.where(np.isfinite(hessian).all(axis=(1, 2), keepdims=True), hessian, 0.0)
    row, column = np.triu_indices(3)
    return np.concatenate((np.zeros((len(hessian), 15)), hessian[:, row, column]), axis=1)
