"""Variances of odometry and closures, from residuals and their redundancy (restricted maximum likelihood)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.noise.vertical import LEAST_TILT, TILT_SPREAD
from rotavg_ros.solver.slam.poses.even.shifts import likeliest_shape
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.row_errors import bent, mean_closure_shift
from rotavg_ros.solver.slam.poses.solved import Solved
from rotavg_ros.solver.slam.poses.state import PoseNoise
from rotavg_ros.solver.slam.posterior.em import likeliest_variance

# Variances that are estimated each by itself; those of odometry's shifts, which are estimated together, and that which
# grows with closures' lengths; the place of tilts among the first; by how many steps at most, and the change that ends
# them.
_ALONE, _OF_SHIFTS, _GROWS = np.array([0, 1, 3, 5, 7, 8]), np.array([2, 6]), [4]
_TILT = 4
_SCORING_STEPS, _SCORED = 20, 1e-3
# Each variance's own prior: median and standard deviation of the logarithm of its root.
_Prior = tuple[float, float]


def likeliest_noise(problem: PoseProblem, solved: Solved) -> PoseNoise:
    """All variances, from their parts of the residuals (Harville 1977), under their priors."""
    noise, places = solved.state.noise, solved.places
    k, segments = problem.turns, np.flatnonzero(~problem.slipped & (problem.jumps == 0))
    redundancy = solved.factor.redundancy[segments]
    half = inverse_root(solved.covariance[segments][:, ::-1, ::-1])[:, ::-1, ::-1].transpose(0, 2, 1)
    pulled = np.matmul(half, solved.left[segments, k:])
    left_over = np.matmul(half, np.matmul(redundancy[:, k:, k:], half.transpose(0, 2, 1)))

    def by_shifts(own: np.ndarray) -> np.ndarray:
        """``(2,)`` squares and freedom of a part ``(S, m, m)`` m² of segments' covariance."""
        squares = np.matmul(pulled.transpose(0, 2, 1), np.matmul(own, pulled)).sum()
        return np.array([squares, np.trace(np.matmul(own, left_over), axis1=1, axis2=2).sum()])

    bending = (bent(problem, solved.way) * problem.tailed[:, None, None])[:, segments]
    left, turns = solved.left[segments, :k, 0], redundancy[:, :k, :k]

    def by_axes(axes: np.ndarray) -> np.ndarray:
        """``(2,)`` the same for turns about some axes, given their projection ``(k, k)``."""
        return np.array([((left @ axes) ** 2).sum(), np.trace(turns @ axes, axis1=1, axis2=2).sum()])

    about = problem.about_drift_axis
    by_turns = by_shifts(noise.turn * bending[0]) + by_axes(about)
    by_tilts = by_shifts(noise.tilt * bending[1]) + by_axes(np.eye(k) - about)
    by_closures = np.stack((places.squares, places.freedom), axis=1)
    runs = slice(len(problem.drawn.source), None)
    alike = (solved.left[runs, k:] ** 2).sum(), np.trace(solved.factor.redundancy[runs, k:, k:], axis1=1, axis2=2).sum()
    beside = problem.beside
    own = (
        (solved.left[beside, k:] ** 2).sum(),
        np.trace(solved.factor.redundancy[beside, k:, k:], axis1=1, axis2=2).sum(),
    )
    used, priors = np.exp(noise.logarithms), priors_of(problem, noise)
    found = np.stack((by_turns, *by_closures, alike, by_tilts, own))
    found[:, 0] *= used[_ALONE]

    def likeliest(told: np.ndarray, number: int) -> float:
        return likeliest_variance(told[0], max(told[1], 0.0), float(np.log(used[number])), *priors[number])

    logarithms = noise.logarithms
    logarithms[_ALONE] = np.log([likeliest(told, number) for number, told in zip(_ALONE, found, strict=True)])
    total = np.trace(solved.covariance[segments], axis1=1, axis2=2) / problem.shifts
    told = (pulled**2).sum(axis=(1, 2)) * total**2, np.trace(left_over, axis1=1, axis2=2) * total
    free = _OF_SHIFTS[: 2 if problem.steps_err else 1]
    travelled = solved.way.travelled[segments, : len(free)]
    logarithms[free] = _likeliest_parts(told, total, travelled, logarithms[free], [priors[each] for each in free])
    logarithms[_GROWS] = _likeliest_growth(problem, solved, priors[_GROWS[0]])
    noise = PoseNoise.of(logarithms)
    if problem.drift_axis is None or noise.tilt > noise.turn:
        # A larger variance of tilts is not allowed: it would make room for false closures.
        alone = likeliest(found[0] + found[_TILT], 0)
        noise = replace(noise, turn=alone, tilt=alone)
    # Runs that join wrong places have a larger common error, and would otherwise raise the bound to fit themselves.
    most = problem.priors.most_common
    farthest = problem.priors.largest_step**2 * problem.typical
    common = min(noise.common, most / (1 - most) * noise.closure)
    tilt = max(noise.tilt, LEAST_TILT**2 * noise.turn)
    within = min(1.0, farthest * problem.typical / float(noise.of_odometry(np.array([problem.typical, 1.0]))))
    return replace(noise, common=common, way=within * noise.way, step=within * noise.step, tilt=tilt)


def likeliest_closure_shape(problem: PoseProblem, shape: np.ndarray, along_body: np.ndarray) -> np.ndarray:
    """``(3, 3)`` shape of closures' shifts in the body's axes, from squares and freedom ``(2, m, m)`` there."""
    if "shift-axes" in problem.mode.problem.without:
        return shape
    axes = problem.bases[1]
    found = likeliest_shape(axes.T @ shape @ axes, *along_body)
    return np.asarray(axes @ found @ axes.T + np.eye(3) - axes @ axes.T)


def _likeliest_growth(problem: PoseProblem, solved: Solved, prior: _Prior) -> np.ndarray:
    """``(1,)`` logarithm of the growth of closures' variance with the squared length.

    Where that is a small part of the variance its freedom is in proportion to it, so its own squares and freedom would
    not tell where it ends. A length that a closure's own error makes longer would explain that error.
    """
    scale, (squares, freedom) = solved.scale, solved.places.pulled
    shaped = scale.floor_share * (mean_closure_shift(problem, solved.state.shape) - 1)
    total = scale.own / scale.shape.size * (1 + shaped)
    told, before = (squares * total**2, freedom * total), solved.state.noise.logarithms[_GROWS]
    return _likeliest_parts(told, total, scale.known_square[:, None], before, [prior])


def _likeliest_parts(
    told: tuple[np.ndarray, np.ndarray],
    total: np.ndarray,
    travelled: np.ndarray,
    before: np.ndarray,
    priors: Sequence[_Prior],
) -> np.ndarray:
    """``(n,)`` logarithms of the variances per unit of each part, together, by Fisher scoring.

    One by one, variances of which one can stand for the other would creep. Each segment's squares S and freedom n count
    as those of its own variance V, −n/2 log V − S/(2 V), whose slope at the variances before is that of the restricted
    likelihood.

    Args:
        told: squares and freedom of S segments, or closures, ``(S,)`` each.
        total: ``(S,)`` m², their variances.
        travelled: ``(S, n)`` units of each part: metres, and steps; or squared lengths.
        before: ``(n,)`` logarithms of the variances before.
        priors: of these.
    """
    squares, freedom = told
    rest = np.maximum(total - travelled @ np.exp(before), 0.0)
    median, spread = np.array(priors).T
    believed, found = 1 / (4 * spread**2), before
    for _ in range(_SCORING_STEPS):
        parts = travelled * np.exp(found)
        whole = rest + parts.sum(axis=1)
        share = parts / whole[:, None]
        slope = (squares / whole - freedom) @ share / 2 - believed * (found - median)
        # Where squares are more than what is expected the curvature is, too, and a step would swing to and fro.
        counted = np.maximum(freedom, squares / whole)
        information = share.T @ (counted[:, None] * share) / 2 + np.diag(believed)
        change = np.clip(np.linalg.solve(information, slope), -1.0, 1.0)
        found = found + change
        if np.abs(change).max() < _SCORED:
            break
    return np.asarray(found)


def log_noise_prior(problem: PoseProblem, noise: PoseNoise) -> float:
    """Log prior of all variances, nats, up to a constant."""
    median, spread = np.array(priors_of(problem, noise)).T
    return -float(((noise.logarithms - median) ** 2 / (8 * spread**2)).sum())


def priors_of(problem: PoseProblem, noise: PoseNoise) -> tuple[_Prior, ...]:
    """Logarithms of median variances, and log standard deviations of their roots; some depend on other variances."""
    of_turns, of_shifts, typical = problem.mode.problem.priors, problem.priors, problem.typical
    own = 2 * float(np.log(of_shifts.closure * typical)) + float(np.log1p(-of_shifts.common))
    return (
        (2 * float(np.log(np.radians(of_turns.step_deg))), of_turns.noise_spread),
        (2 * float(np.log(np.radians(of_turns.closure_deg))), of_turns.noise_spread),
        (float(np.log(of_shifts.step**2 * typical)), of_shifts.step_spread),
        (own, of_shifts.closure_spread),
        (2 * float(np.log(of_shifts.relative)), of_shifts.relative_spread),
        (float(np.log(noise.closure * of_shifts.common / (1 - of_shifts.common))), of_shifts.common_spread),
        (2 * float(np.log(of_shifts.still * typical)), of_shifts.still_spread),
        (float(np.log(noise.turn)), TILT_SPREAD),
        (0.0, of_shifts.closure_spread),
    )
