"""Least squares with a covariance for every edge: the likeliest orientations where noise is normal and small or large.

An edge's noise is ν = log(R_u R_v⁻¹ R̃_uv), a rotation vector in the frame of its source u. The cost is Σ ½ νᵀ C⁻¹ ν.
With R_v ← R_v exp(x_v), ν changes by J⁻¹(ν) R_u (x_u − x_v), J the left Jacobian of the exponential map (Barfoot
2017, §7.1). Gauss–Newton steps solve the block Laplacian of A = J⁻¹(ν) R_u exactly enough by conjugate gradients.

It doubts no covariance, so it is for oracles, which are told them, those of outliers included.
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import bsr_array, csr_array
from scipy.sparse.linalg import cg
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

_MAX_STEPS = 50
# The largest turn of a node that ends it, in radians.
_CONVERGED_STEP = np.radians(1e-4)
_SOLVER_TOLERANCE, _MAX_ITERATIONS = 1e-8, 3000
# No axis is more than a hundred times as exact as the least exact one, so that systems can be solved.
_LEAST_RATIO = 1e-4


def most_likely(graph: ViewGraph, covariance: Tensor, start: Tensor) -> Tensor:
    """Orientations of least summed squared Mahalanobis distance, body_from_world ``(N, 4)`` float64.

    Args:
        graph: M edges.
        covariance: ``(M, 3, 3)`` rad², of each edge's noise in its source's frame.
        start: body_from_world ``(N, 4)``, in the basin of the minimum.
    """
    information = _information(covariance.double().numpy())
    orientations = rotations.normalize(start.double())
    source, target = graph.source.numpy(), graph.target.numpy()
    for _ in range(_MAX_STEPS):
        at_source = orientations[graph.source]
        change = rotations.multiply(at_source, rotations.inverse(orientations[graph.target]))
        noise = rotations.log(rotations.multiply(change, graph.target_from_source)).numpy()
        lever = _inverse_left_jacobian(noise) @ rotations.to_matrix(at_source).numpy()
        pull = lever.transpose(0, 2, 1) @ information
        towards = np.zeros((graph.num_nodes, 3))
        for node, sign in ((target, 1.0), (source, -1.0)):
            np.add.at(towards, node, sign * (pull @ noise[:, :, None])[:, :, 0])
        turn = _solve(source, target, pull @ lever, towards)
        orientations = rotations.multiply(orientations, rotations.exp(torch.from_numpy(turn)))
        if np.linalg.norm(turn, axis=1).max(initial=0.0) < _CONVERGED_STEP:
            break
    return rotations.normalize(orientations)


def _information(covariance: np.ndarray) -> np.ndarray:
    variance, axes = np.linalg.eigh(covariance)
    variance = np.maximum(variance, _LEAST_RATIO * variance[:, -1:])
    return np.asarray((axes / variance[:, None, :]) @ axes.transpose(0, 2, 1))


def _inverse_left_jacobian(vector: np.ndarray) -> np.ndarray:
    """``(M, 3, 3)`` of rotation vectors ``(M, 3)`` shorter than π."""
    cross = np.zeros((len(vector), 3, 3))
    cross[:, [2, 0, 1], [1, 2, 0]] = vector
    cross -= cross.transpose(0, 2, 1)
    half = np.maximum(np.linalg.norm(vector, axis=1), 1e-4) / 2
    square = (1 - half / np.tan(half)) / (4 * half**2)
    return np.asarray(np.eye(3) - cross / 2 + square[:, None, None] * (cross @ cross))


def _solve(source: np.ndarray, target: np.ndarray, blocks: np.ndarray, towards: np.ndarray) -> np.ndarray:
    """Turns ``(N, 3)`` of the block Laplacian's system, preconditioned by its diagonal.

    The system is singular along turns of a whole component, which conjugate gradients never take up.
    """
    num_nodes = len(towards)
    diagonal = np.zeros((num_nodes, 3, 3))
    for ends in (source, target):
        np.add.at(diagonal, ends, blocks)
    node = np.arange(num_nodes)
    rows, columns = (np.concatenate(parts) for parts in ((source, target, node), (target, source, node)))
    values = np.concatenate((-blocks, -blocks.transpose(0, 2, 1), diagonal))
    system = _block_matrix(rows, columns, values, num_nodes)
    is_lonely = np.asarray(diagonal[:, 0, 0] == 0)
    inverse = np.linalg.inv(np.where(is_lonely[:, None, None], np.eye(3), diagonal))
    preconditioner = _block_matrix(node, node, inverse, num_nodes)
    turn, _ = cg(system, towards.ravel(), rtol=_SOLVER_TOLERANCE, maxiter=_MAX_ITERATIONS, M=preconditioner)
    return np.asarray(turn.reshape(num_nodes, 3))


def _block_matrix(rows: np.ndarray, columns: np.ndarray, blocks: np.ndarray, size: int) -> csr_array:
    """Sparse matrix of 3 × 3 blocks; those at the same place are added."""
    order = np.lexsort((columns, rows))
    pointer = np.searchsorted(rows[order], np.arange(size + 1))
    return bsr_array((blocks[order], columns[order], pointer), shape=(3 * size, 3 * size)).tocsr()
