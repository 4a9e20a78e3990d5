"""The likelihood of the translations under a labelling of rotations, nats, by which rival labellings are compared."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.poses.closures import Places
from rotavg_ros.solver.slam.poses.em.noise import log_noise_prior
from rotavg_ros.solver.slam.poses.even.shifts import log_shape_prior
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import closure_turns, common_turn, initial_noise
from rotavg_ros.solver.slam.poses.rows import jacobian, loose_weight, root_weight, whitening
from rotavg_ros.solver.slam.poses.solved import Solved


def translation_cost(problem: PoseProblem, solved: Solved, in_order: Places) -> float:
    """−log p of all translations, given rotations and their labels.

    The sum of −log evidence of the normal densities that approximate all rows, with poses integrated out, and each
    closure's log ratio of its own density's evidence to its approximation's (as for rotations in
    :mod:`rotavg_ros.solver.slam.posterior.objective`), minus the same for rotations alone.

    Args:
        problem: the labelling.
        solved: the converged solve, with rotations' labels held.
        in_order: classes of closures given only those before.
    """
    gained = in_order.log_density - _as_normal(problem, solved) - _gained_by_rotations(problem)
    believed = log_noise_prior(problem, solved.state.noise) - log_noise_prior(problem, initial_noise(problem))
    believed += log_shape_prior(problem.bases[1].T @ solved.state.shape @ problem.bases[1])
    return _normal(problem, solved) - _normal_of_rotations(problem) - float(gained.sum()) - believed


def _normal(problem: PoseProblem, solved: Solved) -> float:
    """−log evidence of the normal densities, without the terms that rotations alone have as well."""
    k, m, drawn = problem.turns, problem.shifts, problem.drawn
    odometry = np.flatnonzero(drawn.is_odometry)
    cost = float((solved.left**2).sum() + _log_det(problem, solved)) / 2
    cost += float(np.linalg.slogdet(solved.covariance[odometry])[1].sum()) / 2
    components = problem.num_about, k - problem.num_about
    cost -= (
        float(np.log(solved.closure_weight).sum()) * m + float(np.log(solved.rotation_weight).sum(axis=0) @ components)
    ) / 2
    cost += m / 2 * problem.num_runs * float(np.log(solved.state.noise.common))
    cost += k / 2 * problem.num_runs * float(np.log(common_turn(problem, solved.state.noise)))
    # Rows minus unknowns, per component of a shift; loose nodes have a prior.
    redundant = len(drawn.source) - drawn.num_nodes + len(drawn.roots) + len(problem.loose)
    return cost + m / 2 * redundant * float(np.log(2 * np.pi))


def _log_det(problem: PoseProblem, solved: Solved) -> float:
    """Log det H; chains that nothing joins have a prior over the map's extent and all turns."""
    if len(problem.loose) == 0:
        return solved.factor.log_det
    state = solved.state
    root = whitening(problem, solved.covariance, solved.rotation_weight, solved.closure_root, state)
    rows, tied = np.matmul(root, jacobian(problem, solved.arms)), root_weight(problem, solved.rotation_weight, state)
    return problem.equations.factorise(rows, tied, loose_weight(problem, solved.scale.extent)).log_det


def _normal_of_rotations(problem: PoseProblem) -> float:
    """The same for rotations alone, at the labelling's optimum."""
    evaluation, k = problem.mode.evaluation, problem.turns
    weight = evaluation.weight[:, None]
    cost = float((weight * evaluation.residual**2).sum() + k * evaluation.factorised.log_det) / 2
    return cost - k / 2 * float(np.log(evaluation.weight).sum())


def _as_normal(problem: PoseProblem, solved: Solved) -> np.ndarray:
    """``(C,)`` nats, log evidence of closures under their normal approximations, given the predictions by all else."""
    k, m, closure = problem.turns, problem.shifts, problem.mode.problem.closure
    total = solved.predictions.covariance.copy()
    total[:, :k, :k] += (1 / solved.rotation_weight[closure, 0])[:, None, None] * np.eye(k)
    back = solved.closure_back
    total[:, k:, k:] += np.matmul(back, back.transpose(0, 2, 1))
    mean = solved.predictions.mean
    square = (mean * np.linalg.solve(total, mean[:, :, None])[:, :, 0]).sum(axis=1)
    return np.asarray(-(square + np.linalg.slogdet(total)[1] + (k + m) * np.log(2 * np.pi)) / 2)


def _gained_by_rotations(problem: PoseProblem) -> np.ndarray:
    """``(C,)`` nats, log ratio of closures' own densities to their approximations, given rotations alone."""
    k, closure, left_out = problem.turns, problem.mode.problem.closure, problem.mode.left_out
    square, predicted = left_out.square[closure], left_out.predicted[closure]

    def log_normal(variance: np.ndarray) -> np.ndarray:
        return np.asarray(-(square / variance + k * np.log(2 * np.pi * variance)) / 2)

    is_good = problem.mode.state.is_good[closure]
    own = log_normal(closure_turns(problem, initial_noise(problem)) + predicted)
    stands = log_normal(1 / problem.mode.evaluation.weight[closure] + predicted)
    return np.asarray(np.where(is_good, own, problem.told.false_odds) - stands)
