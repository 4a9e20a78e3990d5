"""What the rows of the joint system err by: variances of turns, covariances of shifts, and the axes that they have."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.poses.closures import NOTHING
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.even.shifts import EvenShifts
from rotavg_ros.solver.slam.poses.problem import LEAST_LENGTH, PoseProblem
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# The share of an error that is not shared; the system stays solvable.
_NONE = 1e-6


def initial_noise(problem: PoseProblem) -> PoseNoise:
    """Initial noise: turns' from rotations alone, shifts' from the prior."""
    noise, priors, typical = problem.mode.state.noise, problem.priors, problem.typical
    way, closure = priors.step**2 * typical, (priors.closure * typical) ** 2
    own, common = (1 - priors.common) * closure, priors.common * closure
    turn = noise.step_variance
    step = (priors.still * typical) ** 2 if problem.steps_err else LEAST_LENGTH * typical * way
    return PoseNoise(turn, noise.closure_variance, way, own, priors.relative**2, common, step, turn)


def mean_turn(problem: PoseProblem, noise: PoseNoise) -> float:
    """rad², variance of one step of odometry, averaged over components."""
    of_even = float(mean_over_axes(problem, np.array([noise.turn, noise.tilt])))
    return of_even * _mean_square(problem, np.arange(problem.drawn.num_segments))


def mean_closure_turn(problem: PoseProblem, noise: PoseNoise) -> float:
    """rad², variance of a typical good closure, averaged over components."""
    return noise.closure_turn * _mean_square(problem, problem.mode.problem.closure)


def _mean_square(problem: PoseProblem, rows: np.ndarray) -> float:
    """Mean over some edges of the variance of a turn whose even turn has the variance 1."""
    return float(problem.even_turns.mean_square[rows].mean()) if len(rows) else 1.0


def mean_over_axes(problem: PoseProblem, variance: np.ndarray) -> np.ndarray:
    """Variances about the drift axis and any other one, ``(…, 2)`` → their mean over components, ``(…)``."""
    about = problem.num_about / problem.turns
    return np.asarray(about * variance[..., 0] + (1 - about) * variance[..., 1])


def common_turn(problem: PoseProblem, noise: PoseNoise) -> float:
    """rad², variance of the turn that a run has in common; negligible where turns err independently."""
    return noise.closure_turn * (problem.mode.state.noise.common_share if problem.turns_share else _NONE)


def turn_variances(problem: PoseProblem, noise: PoseNoise) -> np.ndarray:
    """``(E, 2)`` rad² about the drift axis and any other one, tails as the last solve weighed them.

    Of even turns; for odometry as labelled, for closures as good ones.
    """
    state, priors, is_odometry = problem.mode.state, problem.mode.problem.priors, problem.drawn.is_odometry
    steps = np.array([[noise.turn, noise.tilt]]) / state.noise.step_variance
    closure = noise.closure_turn / state.noise.closure_variance
    own = problem.own[:, None] * np.where(is_odometry[:, None], steps, closure)
    slip = np.radians(priors.slip_deg) ** 2
    slipped = (is_odometry & ~state.is_good)[:, None]
    return np.asarray(np.where(slipped, own + slip, own / state.others.relative[:, None]))


def closure_turns(problem: PoseProblem, noise: PoseNoise) -> np.ndarray:
    """``(C,)`` rad², variances of closures as good ones."""
    return np.asarray(turn_variances(problem, noise)[problem.mode.problem.closure, 0])


def bridge_variance(problem: PoseProblem, noise: PoseNoise) -> np.ndarray:
    """``(2, S)`` rad² a step within segments, about the drift axis and any other; a slip may be at any step."""
    slip = np.radians(problem.mode.problem.priors.slip_deg) ** 2
    of_step = np.array([[noise.turn], [noise.tilt]])
    slipped = of_step + slip / np.maximum(problem.steps, 1.0)
    return np.asarray(np.where(problem.slipped, slipped, of_step * problem.tailed))


def stated_variance(problem: PoseProblem, state: PoseState) -> np.ndarray:
    """``(C,)`` m² per component, mean over axes, of good closures that are as long as they state."""
    noise = state.noise.of_constant_times(mean_closure_shift(problem, state.shape))
    return noise.of_closures(problem.stated_square)


def own_variance(problem: PoseProblem, noise: PoseNoise, square_length: np.ndarray) -> np.ndarray:
    """``(C,)`` m² per component, the part of good closures' variance that they do not share with their runs.

    Args:
        noise: all variances.
        square_length: ``(C,)`` m², squared lengths of closures.
    """
    is_shared = problem.run[problem.mode.problem.closure] >= 0
    return np.asarray(noise.of_closures(square_length) - is_shared * noise.common)


def even_shifts(problem: PoseProblem, state: PoseState, share: np.ndarray) -> EvenShifts:
    """Units in which closures' shifts err alike along all axes; a share ``(C,)`` of their variances has a shape."""
    drawn, closure = problem.drawn, problem.mode.problem.closure
    older = drawn.nodes[np.where(drawn.is_forward[closure], drawn.source[closure], drawn.target[closure])]
    body_from_world = np.ascontiguousarray(problem.orientations(state)[older].T)
    axes = problem.bases[1]
    frame = axes.T @ quaternion_rows.matrices(quaternion_rows.inverse(body_from_world)) @ axes
    return EvenShifts.of(axes.T @ state.shape @ axes, frame, share)


def stated_covariance(problem: PoseProblem, noise: PoseNoise, shifts: EvenShifts) -> np.ndarray:
    """``(C, m, m)`` m², of the shifts of good closures that are as long as they state, given their shape."""
    alike = noise.of_closures(problem.stated_square) - noise.closure
    shaped = shifts.frame @ shifts.shape @ shifts.frame.transpose(0, 2, 1)
    return np.asarray(alike[:, None, None] * np.eye(problem.shifts) + noise.closure * shaped)


def mean_closure_shift(problem: PoseProblem, shape: np.ndarray) -> float:
    """Variance of a closure's shift, averaged over components, if that of an even one is 1."""
    axes = problem.bases[1]
    return float(np.trace(axes.T @ shape @ axes)) / problem.shifts


def segment_spread(problem: PoseProblem, noise: PoseNoise, way: Displacements) -> np.ndarray:
    """``(S,)`` m² per component, of segments' shifts apart from what bends them: by the way, of slips and of jumps."""
    slip = np.where(problem.slipped, (problem.priors.slip * problem.typical) ** 2, 0.0)
    return np.asarray(noise.of_odometry(way.travelled[: problem.drawn.num_segments]) + slip + problem.jumps)


def shift_covariance(problem: PoseProblem, state: PoseState, way: Displacements) -> np.ndarray:
    """``(E, m, m)`` m², covariance of odometry's shifts; for closures, the unshared part as good ones."""
    drawn, num_segments = problem.drawn, problem.drawn.num_segments
    unit = np.eye(problem.shifts)
    noise = state.noise
    variance = noise.of_odometry(way.travelled)
    slipped = drawn.is_odometry & ~problem.mode.state.is_good
    variance += np.where(slipped, (problem.priors.slip * problem.typical) ** 2, 0.0)
    variance[:num_segments] = segment_spread(problem, noise, way)
    # Odometry beside the chain that is rejected, or states no translation, connects nothing else, so it does not pull.
    pulled = variance[problem.beside]
    variance[num_segments:] /= NOTHING
    variance[problem.beside] = noise.beside * pulled
    variance[problem.mode.problem.closure] = own_variance(problem, noise, problem.stated_square)
    covariance = variance[:, None, None] * unit
    bending = bridge_variance(problem, noise)[:, :, None, None] * bent(problem, way)
    covariance[: drawn.num_segments] += bending.sum(axis=0)
    return np.asarray(covariance)


def bent(problem: PoseProblem, way: Displacements) -> np.ndarray:
    """``(2, S, m, m)`` m² per rad² a step, of segments' shifts due to bending, about the drift axis and the others.

    Turns about n alone contribute ∫ (d × n) (d × n)ᵀ dq to ∫ (‖d‖² I − d dᵀ) dq.
    """
    bridge = way.bridge[: problem.drawn.num_segments]
    return bent_by(problem, np.trace(bridge, axis1=1, axis2=2)[:, None, None] / 2 * np.eye(3) - bridge, bridge)


def bent_by(problem: PoseProblem, square: np.ndarray, whole: np.ndarray) -> np.ndarray:
    """``(2, n, m, m)`` m² per rad² a step, as :func:`bent`.

    Args:
        problem: the graph.
        square: ``(n, 3, 3)`` ∫ d d'ᵀ dq.
        whole: ``(n, 3, 3)`` ∫ (d · d' I − d' dᵀ) dq.
    """
    shifts, about = problem.bases[1], whole
    if problem.drift_axis is not None:
        crossed = np.cross(np.eye(3), problem.drift_axis)
        about = crossed.T @ square @ crossed
    return np.asarray(shifts.T @ np.stack((about, whole - about)) @ shifts)
