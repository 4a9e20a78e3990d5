"""Poses by expectation–maximisation around the joint solve.

It begins with the orientations from rotations alone, and with no closure's translation believed. The predictions of
odometry and turns, lever arms included, tell which may be right. A closure's weight follows from the mean over its
classes, so nearby closures are accepted first, and the poses that they fix judge the others.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.sparse.block_system import BlockFactor
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.poses.closures import ANYWHERE, Places, Predictions, Scale
from rotavg_ros.solver.slam.poses.displacements import Displacements
from rotavg_ros.solver.slam.poses.em.convergence import (
    HELD,
    TO_REST,
    Ending,
    Pace,
    damped,
    following,
    noise_rests,
    poses_rest,
    with_noise,
)
from rotavg_ros.solver.slam.poses.em.evidence import translation_cost
from rotavg_ros.solver.slam.poses.em.noise import likeliest_closure_shape, likeliest_noise, log_noise_prior
from rotavg_ros.solver.slam.poses.em.start import MAX_SOLVES, USUAL, Level, PoseStart, along_odometry
from rotavg_ros.solver.slam.poses.even.shifts import shape_change
from rotavg_ros.solver.slam.poses.places.judge import Judge
from rotavg_ros.solver.slam.poses.problem import PoseProblem
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.row_errors import (
    closure_turns,
    even_shifts,
    own_variance,
    shift_covariance,
    stated_covariance,
    turn_variances,
)
from rotavg_ros.solver.slam.poses.rows import Arms, jacobian, residuals, root_weight, whitening
from rotavg_ros.solver.slam.poses.solved import PoseMode, Solved
from rotavg_ros.solver.slam.poses.state import PoseState
from rotavg_ros.solver.slam.posterior.densities import anyhow

# Units of work per row, for each part of the work beside the factorisation.
_ROW = 0.001
# Largest turn of a node in one step, rad.
_MAX_TURN = 0.3
# Factors of the prior variances of shifts for the alternative starts.
_LEVELS: tuple[Level, ...] = (USUAL, (1 / 16, 1 / 16), (1 / 256, 1 / 256), (1.0, 1 / 256), (1.0, 1 / 4096))
# Least extent of the map, in typical steps.
_LEAST_EXTENT = 3.0


def estimate_poses(
    problem: PoseProblem,
    *,
    hold: bool = False,
    start: PoseStart | None = None,
    level: Level = USUAL,
    ending: Ending = TO_REST,
) -> PoseMode:
    """Poses of a labelling.

    Args:
        problem: the labelling, and translations.
        hold: leave the labels of rotations as they are.
        start: where to begin; default: the answer of rotations, with no closure's translation believed.
        level: for the default start, factors of the prior variances of shifts.
        ending: when to end before convergence.
    """
    is_good = problem.mode.state.is_good[problem.mode.problem.closure]
    judge = judge_of(problem, is_good if hold else None)
    state = along_odometry(problem, level) if start is None else start.state
    places, at_once = _nothing_known(problem, state, judge), np.ones(len(is_good), dtype=bool)
    if start is not None:
        places, at_once = start.over(places), (start.column < 0) & (not start.is_gradual)
    change, sorted_by = np.zeros(len(state.noise.logarithms)), np.zeros_like(places.chance)
    pace = Pace.of(len(is_good))
    number, held, most = 0, *((HELD, MAX_SOLVES) if start is None else (0, start.solves))
    counts_tails, judge = judge.counts_tails, replace(judge, counts_tails=judge.counts_tails and start is not None)
    while True:
        solved = _solve(problem, state, places, judge)
        if number == 0:
            first = _log_likely(problem, solved)
        spend(_ROW * len(solved.left))
        chance, sorted_by = damped(solved.places.chance, places.chance, sorted_by)
        after, pace = pace.towards(replace(solved.places, chance=chance), places, at_once & (number == 0))
        noise = likeliest_noise(problem, solved).logarithms
        spend(_ROW * len(solved.left))
        is_at_rest = poses_rest(solved.moved, after, places, _leverage(problem, solved))
        number += 1
        if is_at_rest:
            held = min(held, number)
        if number == most or ending.is_early(number, after, is_at_rest=is_at_rest):
            break
        is_held = ending.held_for is not None or number <= held
        shape = likeliest_closure_shape(problem, state.shape, solved.places.along_body)
        rests = noise_rests(np.append(noise - state.noise.logarithms, shape_change(shape, state.shape)))
        if number > held and is_at_rest and rests:
            if judge.counts_tails == counts_tails:
                break
            # Only now: while variances are too small most closures seem to be in the tails, which keeps them small.
            judge = replace(judge, counts_tails=True)
        state, change = with_noise(solved.state, noise, change, is_held=is_held)
        state = state if is_held else replace(state, shape=shape)
        places = following(after, problem, solved.scale.square_length, solved.state.noise, state.noise)
    if not hold:
        return PoseMode(problem, solved, math.nan, first)
    used = closure_turns(problem, solved.state.noise)
    judge = replace(judge, told=replace(judge.told, rotation_variance=used))
    in_order = judge(solved.predictions, solved.maps, solved.places.chance, solved.scale, in_order=True)
    return PoseMode(problem, solved, translation_cost(problem, solved, in_order), first)


def judge_of(problem: PoseProblem, held: np.ndarray | None = None) -> Judge:
    """The judge of a labelling's closures, whose rotations' labels ``(C,)`` may be held."""
    counts_tails = "counted-tails" not in problem.mode.problem.without
    return Judge(problem.told, problem.turns, problem.priors, held, counts_tails)


def _solve(problem: PoseProblem, state: PoseState, places: Places, judge: Judge) -> Solved:
    """One Gauss–Newton step, and the classes of closures that follow from it."""
    closure = problem.mode.problem.closure
    way = problem.displacements(problem.orientations(state))
    covariance, turned = shift_covariance(problem, state, way), turn_variances(problem, state.noise)
    rotation_weight = 1 / turned
    rotation_weight[closure] = places.rotation_weight[:, None]
    spend(_ROW * len(turned))
    root = whitening(problem, covariance, rotation_weight, places.closure_root, state)
    arms = Arms.of(problem, state, way)
    rows = np.matmul(root, jacobian(problem, arms))
    factor = problem.equations.factorise(rows, root_weight(problem, rotation_weight, state))
    whitened = np.matmul(root, residuals(problem, state, way)[:, :, None])
    step = factor.fit(whitened)
    state, explained = _after(problem, state, step[:, :, 0]), factor.predicted(step)
    left = whitened - explained
    # xᵀ H x of the step x; for x ~ N(0, H⁻¹) its expectation is the number of unknowns.
    moved_by = math.sqrt(float((explained**2).sum()) / max(step.size, 1))
    # Variance of a closure's shift if neither the place of its source nor its orientation is known.
    anywhere = _extent(problem, state) + problem.stated_square
    spend(_ROW * len(rows))
    predictions = _left_out(factor, root, left, closure)
    predictions = predictions.bounded(problem.turns, anyhow(problem.turns), ANYWHERE * anywhere, problem.within_chain)
    scale = _expected_scale(problem, state, predictions, way)
    judge = replace(judge, told=replace(judge.told, rotation_variance=turned[closure, 0]))
    spend(_ROW * len(rows))
    closure_covariance = stated_covariance(problem, state.noise, scale.shape)
    maps = MapTurns.of(problem, state.position, predictions.wrong, closure_covariance, state.noise.common)
    spend(_ROW * len(rows))
    judged = judge(predictions, maps, places.chance, scale)
    return Solved(
        state,
        way,
        arms,
        covariance,
        rotation_weight,
        places.weight,
        places.even,
        left,
        factor,
        moved_by,
        scale,
        predictions,
        maps,
        judged,
    )


def _leverage(problem: PoseProblem, solved: Solved) -> np.ndarray:
    """``(2, C)`` share of closures' shifts, and of their turns, that their own measurements determine, in the mean."""
    share = np.diagonal(solved.factor.leverage[problem.mode.problem.closure], axis1=1, axis2=2)
    return np.stack((share[:, problem.turns :].mean(axis=1), share[:, : problem.turns].mean(axis=1)))


def _after(problem: PoseProblem, state: PoseState, step: np.ndarray) -> PoseState:
    """The state after a step ``(K + R, d)``, which is shortened where a node would turn too far."""
    k, num_nodes, (turns, shifts) = problem.turns, problem.drawn.num_nodes, problem.bases
    moved = np.concatenate((step[:, :k] @ turns.T, step[:, k:] @ shifts.T), axis=1)
    farthest = float(np.abs(moved[:num_nodes, :3]).max(initial=0.0))
    moved /= max(1.0, farthest / _MAX_TURN)
    correction = quaternion_rows.multiply(state.correction, quaternion_rows.exp(moved[:num_nodes, :3].T))
    return replace(
        state,
        correction=quaternion_rows.normalize(correction),
        position=state.position + moved[:num_nodes, 3:],
        common=state.common + moved[num_nodes:],
    )


def likeliest_level(usual: PoseMode) -> Level:
    """The level of shifts' noise under which closures are likeliest, each independently, before any of them pulls.

    With too large an error, odometry is compatible with every false closure, and these keep it so. With too small an
    error, it rejects true regions. The likelihood of closures under odometry alone gives a guess; −log p decides.

    Args:
        usual: the same labelling, begun with the prior variances.
    """
    problem, told = usual.problem, [usual.first]
    judge = replace(judge_of(problem), counts_tails=False)  # as in the first solve of the usual beginning
    for level in _LEVELS[1:]:
        state = along_odometry(problem, level)
        told.append(_log_likely(problem, _solve(problem, state, _nothing_known(problem, state, judge), judge)))
    return _LEVELS[int(np.argmax(told))]


def _log_likely(problem: PoseProblem, solved: Solved) -> float:
    """Nats, log density of closures, each independently, and of the noise."""
    return float(solved.places.log_density.sum()) + log_noise_prior(problem, solved.state.noise)


def _nothing_known(problem: PoseProblem, state: PoseState, judge: Judge) -> Places:
    closure = problem.mode.problem.closure
    residual = residuals(problem, state, problem.displacements(problem.orientations(state)))
    square, scale = (residual[closure, problem.turns :] ** 2).sum(axis=1), _scale(problem, state, problem.stated_square)
    return judge.nothing_known(problem.mode.state.is_good[closure], square, scale)


def _extent(problem: PoseProblem, state: PoseState) -> float:
    """m² per component, variance of the distance between two places of the map."""
    if problem.extent is not None:
        return problem.extent
    spread = float(np.var(state.position @ problem.bases[1], axis=0).mean())
    return 2 * spread + (_LEAST_EXTENT * problem.typical) ** 2


def _scale(problem: PoseProblem, state: PoseState, square_length: np.ndarray) -> Scale:
    """Scales for closures between places that are ``square_length (C,)`` m² apart."""
    extent, own = _extent(problem, state), own_variance(problem, state.noise, square_length)
    # A closure may state an absurd length, for which Gaussians of the map's extent would not distinguish its classes.
    anywhere = np.maximum(extent, problem.stated_square / problem.shifts)
    # Errors in proportion to the length, and those that others share with their runs, are alike along all axes.
    share = state.noise.closure / own
    shape = even_shifts(problem, state, share)
    good = state.noise.of_closures(square_length) + (shape.size - 1) * own
    return Scale(good, shape.size * own, share, extent, anywhere, square_length, square_length, shape)


def _expected_scale(problem: PoseProblem, state: PoseState, predictions: Predictions, way: Displacements) -> Scale:
    """Scales of closures' errors for the lengths that are expected of closures, given these and all else."""
    if "expected-lengths" in problem.mode.problem.without:
        return _scale(problem, state, problem.stated_square)
    told = way.displacement[problem.mode.problem.closure] @ problem.bases[1]
    square_length = predictions.square_length(told, state.noise.of_closures(problem.stated_square))
    known_square = np.minimum(square_length, predictions.square_length_known(told))
    return replace(_scale(problem, state, square_length), known_square=known_square)


def _left_out(factor: BlockFactor, root: np.ndarray, left: np.ndarray, rows: np.ndarray) -> Predictions:
    """Predictions of some rows by all else, from their residuals and leverages."""
    back = np.linalg.inv(root[rows])
    others, covariance = factor.without(rows)
    mean = np.matmul(back, np.matmul(others, left[rows]))[:, :, 0]
    return Predictions(mean, np.matmul(np.matmul(back, covariance), back.transpose(0, 2, 1)))
