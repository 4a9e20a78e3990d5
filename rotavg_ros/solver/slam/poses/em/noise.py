"""Variances of odometry and closures, from residuals and their redundancy (restricted maximum likelihood)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from rotavg_ros.solver.algebra.small_matrices import inverse_root
from rotavg_ros.solver.slam.noise.vertical import LEAST_TILT, TILT_SPREAD
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.solved import Solved
from rotavg_ros.solver.slam.poses.state import PoseNoise
from rotavg_ros.solver.slam.posterior.em import likeliest_variance

# Each variance's own prior: median and standard deviation of the logarithm of its root.
_Prior = tuple[float, float]


def likeliest_noise(problem: PoseProblem, solved: Solved) -> PoseNoise:
    """All variances, each from its part of the residuals (Harville 1977), under their priors."""
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

    unit = np.eye(problem.shifts)
    by_way = by_shifts(noise.way * solved.way.length[segments, None, None] * unit)
    bent = (problem.bent(solved.way) * problem.tailed[:, None, None])[:, segments]
    left, turns = solved.left[segments, :k, 0], redundancy[:, :k, :k]

    def by_axes(axes: np.ndarray) -> np.ndarray:
        """``(2,)`` the same for turns about some axes, given their projection ``(k, k)``."""
        return np.array([((left @ axes) ** 2).sum(), np.trace(turns @ axes, axis1=1, axis2=2).sum()])

    about = problem.about_drift_axis
    by_turns = by_shifts(noise.turn * bent[0]) + by_axes(about)
    by_tilts = by_shifts(noise.tilt * bent[1]) + by_axes(np.eye(k) - about)
    by_closures = np.stack((places.squares, places.freedom), axis=1)
    runs = slice(len(problem.drawn.source), None)
    alike = (solved.left[runs, k:] ** 2).sum(), np.trace(solved.factor.redundancy[runs, k:, k:], axis1=1, axis2=2).sum()
    used, priors = np.exp(noise.logarithms), priors_of(problem, noise)
    found = np.stack((by_turns, by_closures[0], by_way, *by_closures[1:], alike, by_tilts))
    found[:, 0] *= used

    def likeliest(told: np.ndarray, number: int) -> float:
        return likeliest_variance(told[0], max(told[1], 0.0), float(np.log(used[number])), *priors[number])

    noise = PoseNoise.of(np.log([likeliest(told, number) for number, told in enumerate(found)]))
    if problem.drift_axis is None or noise.tilt > noise.turn:
        # A larger variance of tilts is not allowed: it would make room for false closures.
        alone = likeliest(found[0] + found[-1], 0)
        noise = replace(noise, turn=alone, tilt=alone)
    # Runs that join wrong places have a larger common error, and would otherwise raise the bound to fit themselves.
    most = problem.priors.most_common
    farthest = problem.priors.largest_step**2 * problem.typical
    common = min(noise.common, most / (1 - most) * noise.closure)
    tilt = max(noise.tilt, LEAST_TILT**2 * noise.turn)
    return replace(noise, common=common, way=min(noise.way, farthest), tilt=tilt)


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
        (float(np.log(noise.turn)), TILT_SPREAD),
    )
