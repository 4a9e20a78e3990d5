"""Least squares on poses: Gauss–Newton over turns and shifts together, with given deviations."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.sparse import bsr_array
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation
from torch import Tensor

from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.solver.algebra.sparse.laplacian import LaplacianSystem
from rotavg_ros.view_graph import ViewGraph

FloatArray = NDArray[np.float64]

_MAX_STEPS = 100
# It ends where no turn (rad) or shift (m) is larger.
_CONVERGED_STEP = 1e-6
# What ties the first pose down, in units of the heaviest diagonal entry.
_GROUNDING = 1e3
# A step is halved so often at most before it is taken to be none.
_MAX_HALVINGS = 10
# Components of (turn, shift) that motion in the plane has: yaw, x, y.
_PLANAR = np.array([2, 3, 4])


class PoseAnswer(NamedTuple):
    """Orientations body_from_world ``(N, 4)`` xyzw, and positions ``(N, 3)`` metres in the world frame."""

    body_from_world: Tensor
    position: FloatArray


class _State(NamedTuple):
    world_from_body: Rotation
    position: FloatArray


def is_planar(graph: ViewGraph) -> bool:
    """Whether all turns are yaw and no translation leaves the plane."""
    assert graph.translation is not None
    return not bool(graph.target_from_source[:, :2].any()) and not bool(graph.translation[:, 2].any())


def start_of_poses(graph: ViewGraph, sigma: FloatArray) -> PoseAnswer:
    """Rotations by themselves, then positions along them; arguments as of :func:`pose_least_squares`."""
    precise = replace(graph, precision=torch.from_numpy(sigma[:, 0] ** -2.0))
    body_from_world = least_squares(precise, np.ones(graph.num_edges, dtype=bool))
    assert graph.translation is not None
    source, target = graph.source.numpy(), graph.target.numpy()
    world_from_body = Rotation.from_quat(body_from_world.numpy()).inv()
    step = world_from_body[source].apply(graph.translation.numpy()).reshape(-1, 3)
    weight = sigma[:, 1] ** -2.0
    system = LaplacianSystem(graph.num_nodes, source, target, weight / np.median(weight), np.zeros(1, dtype=np.int64))
    return PoseAnswer(body_from_world, system.fit(step))


def pose_least_squares(graph: ViewGraph, sigma: FloatArray, start: PoseAnswer) -> PoseAnswer:
    """The poses of least squared residuals, by Gauss–Newton with halved steps.

    Of an edge u → v with rotation R̃ and translation t, and world_from_body W, residuals are the turn log(W_v R̃ W_uᵀ)
    over its deviation, and the shift p_v − p_u − W_u t over its own, both in the world frame.

    Args:
        graph: connected, every edge with a translation.
        sigma: ``(M, 2)`` rad and metres per component.
        start: where to begin; its first pose stays.
    """
    components = _PLANAR if is_planar(graph) else np.arange(6)
    weight = np.repeat(sigma**-2.0, 3, axis=1)[:, components]
    state = _State(Rotation.from_quat(start.body_from_world.numpy()).inv(), start.position)
    residual = _residuals(graph, state)[:, components]
    for _ in range(_MAX_STEPS):
        step = np.zeros((graph.num_nodes, 6))
        step[:, components] = _gauss_newton_step(graph, state, residual, weight)
        cost, share = float((weight * residual**2).sum()), 1.0
        for _ in range(_MAX_HALVINGS):
            moved = _moved(state, share * step)
            residual = _residuals(graph, moved)[:, components]
            if float((weight * residual**2).sum()) <= cost:
                break
            share /= 2
        else:
            break
        state = moved
        if np.abs(share * step).max(initial=0.0) < _CONVERGED_STEP:
            break
    body_from_world = torch.from_numpy(state.world_from_body.inv().as_quat(canonical=True))
    return PoseAnswer(body_from_world, state.position)


def _residuals(graph: ViewGraph, state: _State) -> FloatArray:
    """``(M, 6)``: turn and shift in the world frame."""
    assert graph.translation is not None
    source, target = graph.source.numpy(), graph.target.numpy()
    measured = Rotation.from_quat(graph.target_from_source.numpy())
    turn = (state.world_from_body[target] * measured * state.world_from_body[source].inv()).as_rotvec()
    lever = state.world_from_body[source].apply(graph.translation.numpy()).reshape(-1, 3)
    return np.concatenate((turn, state.position[target] - state.position[source] - lever), axis=1)


def _moved(state: _State, step: FloatArray) -> _State:
    return _State(Rotation.from_rotvec(step[:, :3]) * state.world_from_body, state.position + step[:, 3:])


def _gauss_newton_step(graph: ViewGraph, state: _State, residual: FloatArray, weight: FloatArray) -> FloatArray:
    """``(N, C)``, of the components that there are.

    A turn δ of the source changes the turn's residual by −J_r⁻¹ δ and the shift's by lever × δ, one of the target the
    turn's by J_l⁻¹ δ.
    """
    assert graph.translation is not None
    source, target, num_edges = graph.source.numpy(), graph.target.numpy(), graph.num_edges
    components = _PLANAR if weight.shape[1] == len(_PLANAR) else np.arange(6)
    lever = state.world_from_body[source].apply(graph.translation.numpy()).reshape(-1, 3)
    of_source, of_target = np.zeros((num_edges, 6, 6)), np.zeros((num_edges, 6, 6))
    left, right = _inverse_jacobians(residual, components)
    of_target[:, :3, :3] = left
    of_source[:, :3, :3] = -right
    of_source[:, 3:, :3] = _cross(lever)
    of_target[:, 3:, 3:] = np.eye(3)
    of_source[:, 3:, 3:] = -np.eye(3)
    of_source, of_target = (jacobian[:, components][:, :, components] for jacobian in (of_source, of_target))
    weighted_source, weighted_target = weight[:, :, None] * of_source, weight[:, :, None] * of_target
    blocks = np.concatenate(
        (
            np.einsum("mji,mjk->mik", of_source, weighted_source),
            np.einsum("mji,mjk->mik", of_target, weighted_target),
            np.einsum("mji,mjk->mik", of_source, weighted_target),
            np.einsum("mji,mjk->mik", of_target, weighted_source),
        )
    )
    heaviest = float(np.abs(blocks).max())
    rows = np.concatenate((source, target, source, target, [0]))
    columns = np.concatenate((source, target, target, source, [0]))
    blocks = np.concatenate((blocks, (_GROUNDING * heaviest * np.eye(len(components)))[None]))
    right_hand_side = np.zeros((graph.num_nodes, len(components)))
    np.add.at(right_hand_side, source, -np.einsum("mji,mj->mi", weighted_source, residual))
    np.add.at(right_hand_side, target, -np.einsum("mji,mj->mi", weighted_target, residual))
    order = np.lexsort((columns, rows))
    size = len(components) * graph.num_nodes
    pointer = np.searchsorted(rows[order], np.arange(graph.num_nodes + 1))
    matrix = bsr_array((blocks[order], columns[order], pointer), shape=(size, size)).tocsc()
    factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return np.asarray(factor.solve(right_hand_side.reshape(-1)).reshape(right_hand_side.shape))


def _inverse_jacobians(residual: FloatArray, components: NDArray[np.int64]) -> tuple[FloatArray, FloatArray]:
    """How the turn's residual r changes with a turn of the target (J_l⁻¹) and of the source (J_r⁻¹), ``(M, 3, 3)``.

    J⁻¹ = I ∓ [r]×/2 + (1/θ² − (1 + cos θ)/(2 θ sin θ)) [r]×².
    """
    turn = np.zeros((len(residual), 6))
    turn[:, components] = residual
    angle = np.maximum(np.linalg.norm(turn[:, :3], axis=1), 1e-4)
    factor = 1 / angle**2 - 1 / (2 * angle * np.tan(angle / 2))
    cross = _cross(turn[:, :3])
    even = np.eye(3) + factor[:, None, None] * (cross @ cross)
    return even - cross / 2, even + cross / 2


def _cross(vector: FloatArray) -> FloatArray:
    """``(M, 3, 3)`` matrices [v]×."""
    matrix = np.zeros((len(vector), 3, 3))
    x, y, z = vector.T
    matrix[:, 0, 1], matrix[:, 0, 2], matrix[:, 1, 2] = -z, y, -x
    return np.asarray(matrix - matrix.transpose(0, 2, 1))
