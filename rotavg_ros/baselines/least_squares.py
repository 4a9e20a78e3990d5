"""Least squares on chosen edges with their stated precisions, from a chordal start: the reference and the oracle."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import bsr_array, csc_array
from scipy.sparse.linalg import splu
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.view_graph import ViewGraph

_MAX_STEPS = 100
_CONVERGED_STEP = np.radians(1e-4)
# An edge that states no precision counts as if its noise were one degree, and one that is left out as this much of one
# that is not: enough for a graph that falls apart without it to stay solvable.
_DEFAULT_PRECISION = np.radians(1.0) ** -2
_LEFT_OUT = 1e-9
# What ties a component's first node to the identity, in units of the heaviest edge.
_GROUNDING = 1e3


def least_squares(graph: ViewGraph, is_used: np.ndarray) -> Tensor:
    """Orientations of least squared geodesic residuals, weighted by the precisions that the edges state.

    Gauss–Newton from :func:`chordal_orientations`, which without false edges lies in the basin of the minimum.

    Args:
        is_used: ``(M,)`` bool, which edges count.

    Returns:
        body_from_world ``(N, 4)``, the first node of every component at the identity.
    """
    weight = _weights(graph, is_used)
    roots = _roots(graph)
    orientations = chordal_orientations(graph, is_used)
    source, target = graph.source.numpy(), graph.target.numpy()
    system = LaplacianSystem(graph.num_nodes, source, target, weight, roots)
    for _ in range(_MAX_STEPS):
        residual = edge_residual(orientations, graph.target_from_source, graph.source, graph.target)
        step = system.fit(rotations.log(residual).numpy())
        orientations = rotations.multiply(orientations, rotations.exp(torch.from_numpy(step)))
        if np.abs(step).max(initial=0.0) < _CONVERGED_STEP:
            break
    return rotations.normalize(orientations)


def chordal_orientations(graph: ViewGraph, is_used: np.ndarray) -> Tensor:
    """Chordal relaxation (Martinec & Pajdla 2007): the matrices that fit best, then the rotations nearest to them.

    Returns:
        body_from_world ``(N, 4)``, the first node of every component at the identity.
    """
    num_nodes = graph.num_nodes
    source, target = graph.source.numpy(), graph.target.numpy()
    weight = _weights(graph, is_used)
    measured = weight[:, None, None] * rotations.to_matrix(graph.target_from_source).numpy()
    identity = np.eye(3)
    degree = np.bincount(source, weight, num_nodes) + np.bincount(target, weight, num_nodes)
    grounding = np.zeros(num_nodes)
    grounding[_roots(graph)] = _GROUNDING * weight.max(initial=1.0)
    # ‖M_v − R̃_uv M_u‖² over all edges has the normal matrix of a Laplacian with rotations for off-diagonal entries.
    blocks = np.concatenate((-measured, -measured.transpose(0, 2, 1), (degree + grounding)[:, None, None] * identity))
    rows = np.concatenate((target, source, np.arange(num_nodes)))
    columns = np.concatenate((source, target, np.arange(num_nodes)))
    factor = splu(
        _block_matrix(rows, columns, blocks, num_nodes),
        permc_spec="MMD_AT_PLUS_A",
        diag_pivot_thresh=0.0,
        options={"SymmetricMode": True},
    )
    right_hand_side = (grounding[:, None, None] * identity).reshape(3 * num_nodes, 3)
    matrices = factor.solve(right_hand_side).reshape(num_nodes, 3, 3)
    return rotations.from_matrix(torch.from_numpy(_nearest_rotations(matrices)))


def _block_matrix(rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, size: int) -> csc_array:
    """Sparse matrix of 3 × 3 blocks; those at the same place are added."""
    order = np.lexsort((columns, rows))
    pointer = np.searchsorted(rows[order], np.arange(size + 1))
    return bsr_array((blocks[order], columns[order], pointer), shape=(3 * size, 3 * size)).tocsc()


def _nearest_rotations(matrices: np.ndarray) -> np.ndarray:
    left, _, right = np.linalg.svd(matrices)
    handedness = np.linalg.det(left) * np.linalg.det(right)
    left[:, :, 2] *= handedness[:, None]
    return np.asarray(left @ right)


def _weights(graph: ViewGraph, is_used: np.ndarray) -> np.ndarray:
    precision = np.nan_to_num(graph.precision.numpy(), nan=_DEFAULT_PRECISION)
    return np.asarray(np.where(is_used, 1.0, _LEFT_OUT) * precision / np.median(precision))


def _roots(graph: ViewGraph) -> np.ndarray:
    """First node of every component."""
    return np.unique(graph.components().numpy(), return_index=True)[1]
