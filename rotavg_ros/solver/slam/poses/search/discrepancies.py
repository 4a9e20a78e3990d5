"""Discrepancies of several closures that do not pull, jointly: those of a run, or of all across a jump."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.poses.row_errors import closure_turns, stated_variance
from rotavg_ros.solver.slam.poses.rows import jacobian
from rotavg_ros.solver.slam.poses.solved import PoseMode


def discrepancies(pose: PoseMode, members: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Covariance ``(K d, K d)`` of the discrepancies of K closures if they are right, and these ``(K d,)``."""
    problem, solved = pose.problem, pose.solved
    rows = problem.mode.problem.closure[members]
    predicted = solved.factor.covariance_between(jacobian(problem, solved.arms)[rows], rows)
    return predicted + np.diag(own_variances(pose, members).ravel()), solved.predictions.mean[members].ravel()


def own_variances(pose: PoseMode, members: np.ndarray) -> np.ndarray:
    """``(K, d)`` rad² and m², of the own noise of K closures, without what they share with their runs."""
    problem, k = pose.problem, pose.problem.turns
    own = np.repeat(closure_turns(problem, pose.state.noise)[members, None], k + problem.shifts, axis=1)
    shared = np.where(problem.run[problem.mode.problem.closure] >= 0, pose.state.noise.common, 0.0)
    own[:, k:] = (stated_variance(problem, pose.state) - shared)[members, None]
    return own


def log_normal(off: np.ndarray, covariance: np.ndarray) -> np.ndarray:
    """``(n,)`` nats, log densities of ``(n, d)`` with covariances ``(n, d, d)``, up to a constant."""
    square = (off * np.linalg.solve(covariance, off[:, :, None])[:, :, 0]).sum(axis=1)
    return np.asarray(-(square + np.linalg.slogdet(covariance)[1]) / 2)
