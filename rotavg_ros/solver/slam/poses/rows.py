"""The rows of the joint system: residuals of turns and shifts, what they depend on, and their weights."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.poses.closures import ANYWHERE
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.problem import PoseProblem, crossing
from rotavg_ros.solver.slam.poses.row_errors import common_turn
from rotavg_ros.solver.slam.poses.state import PoseState
from rotavg_ros.solver.slam.posterior.densities import anyhow

# Stiffness of the roots, relative to the stiffest row.
_GROUNDING = 1e6


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


class Arms(NamedTuple):
    """How shifts of E edges turn with their ends.

    Attributes:
        at_target, at_source: ``(E, 3)`` metres, B and A (:mod:`rotavg_ros.solver.slam.poses.displacements`).
    """

    at_target: np.ndarray
    at_source: np.ndarray

    @classmethod
    def of(cls, problem: PoseProblem, state: PoseState, way: Displacements) -> Arms:
        """Of edges as they lie: A + B = p_b − p_a.

        A shift's error is the body's, and turns with it. With A and B as measured each row would hold the whole graph,
        and each robot, against turns by the square of its own residual: a robot that a single closure joins seemed to
        be known to 23° without that one.
        """
        source, target = problem.drawn.source, problem.drawn.target
        off = way.displacement - (state.position[target] - state.position[source])
        off = off @ problem.bases[1] @ problem.bases[1].T
        # Errors of segments arise evenly along them, those of others where they were measured.
        share = problem.drawn.is_forward.astype(float)[:, None]
        share[: problem.drawn.num_segments] = 0.5
        return cls(way.at_target - (1 - share) * off, way.at_source - share * off)


def jacobian(problem: PoseProblem, arms: Arms) -> np.ndarray:
    """``(E + R, d, 3 d)`` by the blocks of target, source and run."""
    k, d = problem.turns, problem.turns + problem.shifts
    num_edges = len(problem.drawn.source)
    rows = np.zeros((num_edges + problem.num_runs, d, 3 * d))
    edges, unit = rows[:num_edges], np.eye(d)
    edges[:, :, :d], edges[:, :, d : 2 * d] = unit, -unit
    edges[:, :k, :k], edges[:, :k, d : d + k] = problem.even_turns.even, -problem.even_turns.even
    edges[:, k:, :k] = -crossed(problem, arms.at_target)
    edges[:, k:, d : d + k] = -crossed(problem, arms.at_source)
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
    turn, shift = anyhow(problem.turns), ANYWHERE * extent
    return np.concatenate((np.full(problem.turns, 1 / turn), np.full(problem.shifts, 1 / shift)))


def root_weight(problem: PoseProblem, rotation_weight: np.ndarray, state: PoseState) -> np.ndarray:
    """``(d,)`` weight that ties roots down."""
    shift = max(1 / state.noise.step, 1 / state.noise.closure)
    tied = np.full(problem.turns, float(rotation_weight.max())), np.full(problem.shifts, shift)
    return _GROUNDING * np.concatenate(tied)
