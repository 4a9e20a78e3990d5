"""The rows of the joint system: residuals of turns and shifts, what they depend on, and their weights."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.poses.closures import ANYHOW
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import common_turn
from rotavg_ros.solver.slam.poses.state import PoseState

# Stiffness of the roots, relative to the stiffest row.
_GROUNDING = 1e6


def crossing(turns: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """``(3, m k)`` map from v to the entries of v × in bases ``(3, k)`` and ``(3, m)``: (v × a) · b = v · (a × b)."""
    return np.asarray(np.cross(turns.T[None], shifts.T[:, None]).reshape(-1, 3).T)


def residuals(problem: PoseProblem, state: PoseState, way: Displacements) -> np.ndarray:
    """``(E + R, k + m)`` measured minus predicted, with even turns."""
    drawn, (turns, shifts) = problem.drawn, problem.bases
    measured = problem.mode.problem.measured
    turn = quaternion_rows.residual_vectors(state.correction, measured, drawn.source, drawn.target)
    shift = way.displacement - (state.position[drawn.target] - state.position[drawn.source])
    even = np.matmul(problem.even_turns.even, (turn @ turns)[:, :, None])[:, :, 0]
    both = np.concatenate((even, shift @ shifts), axis=1)
    common = np.concatenate((state.common[:, :3] @ turns, state.common[:, 3:] @ shifts), axis=1)
    shared = np.flatnonzero(problem.run >= 0)
    both[shared] -= problem.sign[shared, None] * common[problem.run[shared]]
    return np.concatenate((both, -common))


def jacobian(problem: PoseProblem, way: Displacements) -> np.ndarray:
    """``(E + R, d, 3 d)`` by the blocks of target, source and run."""
    k, d = problem.turns, problem.turns + problem.shifts
    num_edges = len(problem.drawn.source)
    rows = np.zeros((num_edges + problem.num_runs, d, 3 * d))
    edges, unit = rows[:num_edges], np.eye(d)
    edges[:, :, :d], edges[:, :, d : 2 * d] = unit, -unit
    edges[:, :k, :k], edges[:, :k, d : d + k] = problem.even_turns.even, -problem.even_turns.even
    edges[:, k:, :k] = -crossed(problem, way.at_target)
    edges[:, k:, d : d + k] = -crossed(problem, way.at_source)
    edges[:, :, 2 * d :] = problem.sign[:, None, None] * unit
    rows[num_edges:, :, :d] = unit
    return rows


def crossed(problem: PoseProblem, vector: np.ndarray) -> np.ndarray:
    """``(E, m, k)`` matrices of v × in the bases."""
    return np.asarray((vector @ crossing(*problem.bases)).reshape(len(vector), problem.shifts, problem.turns))


def whitening(
    problem: PoseProblem,
    covariance: np.ndarray,
    rotation_weight: np.ndarray,
    closure_root: np.ndarray,
    state: PoseState,
) -> np.ndarray:
    """``(E + R, d, d)`` W^½ of all rows.

    Args:
        covariance: ``(E, m, m)`` covariances of shifts.
        rotation_weight: ``(E, 2)`` rad⁻², about the drift axis and any other one.
        closure_root: ``(C, m, m)`` m⁻¹, of closures' shifts.
        state: gives the noise.
    """
    k, m = problem.turns, problem.shifts
    num_edges = len(covariance)
    root = np.zeros((num_edges + problem.num_runs, k + m, k + m))
    edges, common = root[:num_edges], root[num_edges:]
    about, other = np.sqrt(rotation_weight).T[:, :, None, None]
    edges[:, :k, :k] = about * problem.about_drift_axis + other * (np.eye(k) - problem.about_drift_axis)
    # Upper triangular: Cholesky from the last component backwards.
    edges[:, k:, k:] = inverse_root(covariance[:, ::-1, ::-1])[:, ::-1, ::-1]
    edges[problem.mode.problem.closure, k:, k:] = closure_root
    if problem.num_runs:
        common[:, :k, :k] = np.eye(k) / np.sqrt(common_turn(problem, state.noise))
        common[:, k:, k:] = np.eye(m) / np.sqrt(state.noise.common)
    return root


def loose_weight(problem: PoseProblem, extent: float) -> np.ndarray:
    """``(d,)`` weight of chains that nothing joins: any turn, and anywhere on a map of ``extent`` m²."""
    return np.concatenate((np.full(problem.turns, 1 / ANYHOW), np.full(problem.shifts, 1 / extent)))


def root_weight(problem: PoseProblem, rotation_weight: np.ndarray, state: PoseState) -> np.ndarray:
    """``(d,)`` weight that ties roots down."""
    shift = max(1 / state.noise.step, 1 / state.noise.closure)
    tied = np.full(problem.turns, float(rotation_weight.max())), np.full(problem.shifts, shift)
    return _GROUNDING * np.concatenate(tied)
