"""Poses by expectation–maximisation around the joint solve.

It begins with the orientations that rotations alone give and no closure's translation believed. What odometry and turns
predict of each, lever arms included, tells which may be; a closure pulls as far as its classes' mean lets it, so that
those near by come in first, and what they tie down judges the others.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.sparse.block_system import BlockFactor
from rotavg_ros.solver.running.work import rest, spend
from rotavg_ros.solver.slam.poses.closures import ANYHOW, NOTHING, REPEATS, Places, Predictions, Scale
from rotavg_ros.solver.slam.poses.evidence import translation_cost
from rotavg_ros.solver.slam.poses.noise import likeliest_noise, log_noise_prior
from rotavg_ros.solver.slam.poses.places.judge import Judge
from rotavg_ros.solver.slam.poses.repeats.map_turns import MapTurns
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.poses.solved import Solved
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState

# Units of work for each row, of each third of what is done beside the factorisation.
_ROW = 0.012
_MAX_SOLVES = 28
# An update goes no further: the next one goes on from there.
_MAX_UPDATE_SOLVES = 6
# A step turns nothing by more than this, rad.
_MAX_TURN = 0.3
# Variances change by no more than this factor from solve to solve; most stay while places are sorted out, for so
# many solves at most.
_SLOWEST, HELD = 16.0, 8
# After so many it is told whether places come out as those of other poses.
_ALIKE_AFTER = 4
# Which variances do not: those of closures' shifts by themselves.
_FREE = np.array([False, False, False, True, True, False, False])
# Variances of shifts to begin with, of odometry and of closures, in those that are believed beforehand.
Level = tuple[float, float]
USUAL: Level = (1.0, 1.0)
_LEVELS: tuple[Level, ...] = (USUAL, (1 / 16, 1 / 16), (1 / 256, 1 / 256), (1.0, 1 / 256), (1.0, 1 / 4096))
# A variance whose change is a constant multiple of the one before is set to where that leads; of these at most. The
# multiple of one that swings is negative.
_LEAST_RATIO, _LARGEST_RATIO = -2.0, 0.6
# Weights go this share of the way to what they should be, in the logarithm, those that swing less, down to the other.
_SHARE, _LEAST_SHARE = 0.5, 0.1
# At rest: a step's root mean square in standard errors; chances of classes; logarithms of variances.
_STEP_CONVERGED, _CHANCE_CONVERGED, _NOISE_CONVERGED = 0.05, 0.1, 0.1
# No two places are nearer than so many typical steps.
_LEAST_EXTENT = 3.0


@dataclass(frozen=True)
class PoseMode:
    """A labelling's poses.

    Attributes:
        problem: the graph.
        solved: the last solve.
        cost: −log p of translations given what rotations say, nats; NaN unless rotations' labels were held.
        first: nats, what the first solve made of closures and noise (:func:`likeliest_level`).
    """

    problem: PoseProblem
    solved: Solved
    cost: float
    first: float

    @property
    def state(self) -> PoseState:
        """Where the key nodes are, and the noise."""
        return self.solved.state

    def jumps_like(self, other: PoseMode) -> bool:
        """Whether odometry's position jumps in the same segments."""
        return np.array_equal(self.problem.jumps > 0, other.problem.jumps > 0)


@dataclass(frozen=True)
class PoseStart:
    """What an earlier estimate came to.

    Attributes:
        state: key nodes and noise.
        column: ``(C,)`` where the places of each closure are, -1 of those that are new.
        places: as they were judged.
        solves: at most from there.
    """

    state: PoseState
    column: np.ndarray
    places: Places
    solves: int = _MAX_UPDATE_SOLVES

    @classmethod
    def at(cls, pose: PoseMode) -> PoseStart:
        """Of the same labelling."""
        return cls(pose.state, np.arange(len(pose.solved.places.weight)), pose.solved.places, _MAX_SOLVES)

    @classmethod
    def believing(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """Of the same labelling, but that some closures ``(n,)`` are right."""
        problem, noise, places = pose.problem, pose.state.noise, pose.solved.places
        chance, weight, rotation = places.chance.copy(), places.weight.copy(), places.rotation_weight.copy()
        chance[:, closures] = 0.0
        chance[0, closures] = 1.0
        weight[closures] = 1 / problem.own_variance(noise)[closures]
        rotation[closures] = 1 / problem.closure_turns(noise)[closures]
        begun = replace(places, chance=chance, weight=weight, rotation_weight=rotation)
        return replace(cls.at(pose), places=begun)

    @classmethod
    def doubting(cls, pose: PoseMode, closures: np.ndarray) -> PoseStart:
        """Of the same labelling, but that some closures ``(n,)`` join the same wrong places, turned as they say."""
        places = pose.solved.places
        chance, weight = places.chance.copy(), places.weight.copy()
        chance[:, closures] = 0.0
        chance[REPEATS, closures] = 1.0
        weight[closures] *= NOTHING
        return replace(cls.at(pose), places=replace(places, chance=chance, weight=weight))

    def over(self, places: Places) -> Places:
        """These, and others' ``places`` of what is new."""
        is_new, column = self.column < 0, self.column
        return replace(
            places,
            chance=np.where(is_new, places.chance, self.places.chance[:, column]),
            weight=np.where(is_new, places.weight, self.places.weight[column]),
            rotation_weight=np.where(is_new, places.rotation_weight, self.places.rotation_weight[column]),
        )


def estimate_poses(
    problem: PoseProblem,
    *,
    hold: bool = False,
    start: PoseStart | None = None,
    level: Level = USUAL,
    until: PoseMode | None = None,
    held_for: int | None = None,
) -> PoseMode:
    """Poses of a labelling.

    Args:
        problem: the labelling, and translations.
        hold: leave the labels of rotations as they are.
        start: where to begin; default: at what rotations say, no closure's translation believed, …
        level: … with variances of shifts so many times what is believed beforehand.
        until: no further than where these poses' closures join right places, too.
        held_for: so many solves at most, with most variances as they begin, or until places rest.
    """
    is_good = problem.mode.state.is_good[problem.mode.problem.closure]
    judge = Judge(problem.told, problem.turns, problem.priors, is_good if hold else None)
    state = _begin(problem, level) if start is None else start.state
    places, is_new = _nothing_known(problem, state, judge), np.ones(len(is_good), dtype=bool)
    if start is not None:
        places, is_new = start.over(places), start.column < 0
    change, sorted_by = np.zeros(len(state.noise.logarithms)), np.zeros_like(places.chance)
    pace = Pace(np.full((2, len(is_good)), _SHARE), np.zeros((2, len(is_good))))
    number, held, most = 0, *((HELD, _MAX_SOLVES) if start is None else (0, start.solves))
    while True:
        solved = _solve(problem, state, places, judge)
        if number == 0:
            first = _log_likely(problem, solved)
        rest()
        chance, sorted_by = _settling(solved.places.chance, places.chance, sorted_by)
        after, pace = pace.towards(replace(solved.places, chance=chance), places, is_new & (number == 0))
        noise = likeliest_noise(problem, solved).logarithms
        rest()
        changed = np.abs(after.chance - places.chance).max(initial=0.0)
        is_at_rest = solved.moved < _STEP_CONVERGED and changed < _CHANCE_CONVERGED
        number += 1
        if is_at_rest:
            held = min(held, number)
        if held_for is not None and (is_at_rest or number == held_for):
            break
        if until is not None and number >= _ALIKE_AFTER and after.is_like(until.solved.places):
            break
        if number == most or (
            number > held and is_at_rest and np.abs(noise - state.noise.logarithms).max() < _NOISE_CONVERGED
        ):
            break
        state, change = _with_noise(solved.state, noise, change, is_held=held_for is not None or number <= held)
        places = _following(after, problem, solved.state.noise, state.noise)
    if not hold:
        return PoseMode(problem, solved, math.nan, first)
    used = problem.closure_turns(solved.state.noise)
    judge = replace(judge, told=replace(judge.told, rotation_variance=used))
    in_order = judge(solved.predictions, solved.maps, solved.places.chance, solved.scale, in_order=True)
    return PoseMode(problem, solved, translation_cost(problem, solved, in_order), first)


def _solve(problem: PoseProblem, state: PoseState, places: Places, judge: Judge) -> Solved:
    """One Gauss–Newton step, and classes of closures by what it tells."""
    closure, k, num_nodes = problem.mode.problem.closure, problem.turns, problem.drawn.num_nodes
    way = problem.displacements(problem.orientations(state))
    residual, covariance = problem.residuals(state, way), problem.shift_covariance(state, way)
    turn_variances = problem.turn_variances(state.noise)
    rotation_weight = 1 / turn_variances
    rotation_weight[closure] = places.rotation_weight[:, None]
    rest()
    root = problem.whitening(covariance, rotation_weight, places.weight, state)
    jacobian = np.matmul(root, problem.jacobian(way))
    factor = problem.equations.factorise(jacobian, problem.root_weight(rotation_weight, state))
    whitened = np.matmul(root, residual[:, :, None])
    step = factor.fit(whitened)
    turns, shifts = problem.bases
    moved = np.concatenate((step[:, :k, 0] @ turns.T, step[:, k:, 0] @ shifts.T), axis=1)
    turned = float(np.abs(moved[:num_nodes, :3]).max(initial=0.0))
    moved /= max(1.0, turned / _MAX_TURN)
    correction = quaternion_rows.multiply(state.correction, quaternion_rows.exp(moved[:num_nodes, :3].T))
    state = replace(
        state,
        correction=quaternion_rows.normalize(correction),
        position=state.position + moved[:num_nodes, 3:],
        common=state.common + moved[num_nodes:],
    )
    explained = factor.predicted(step)
    left = whitened - explained
    # xᵀ H x of a step x, whose mean is one for each unknown where x is drawn from N(0, H⁻¹).
    moved_by = math.sqrt(float((explained**2).sum()) / max(step.size, 1))
    scale = _scale(problem, state)
    # Wherever a closure's source is, and however it is turned.
    anywhere = scale.extent + (problem.lengths[problem.closures] ** 2).sum(axis=1)
    spend(_ROW * len(jacobian))
    predictions = _left_out(factor, root, left, closure).within(k, ANYHOW, anywhere)
    judge = replace(judge, told=replace(judge.told, rotation_variance=turn_variances[closure, 0]))
    spend(_ROW * len(jacobian))
    maps = MapTurns.of(problem, state.position, predictions, scale.good)
    spend(_ROW * len(jacobian))
    judged = judge(predictions, maps, places.chance, scale)
    return Solved(
        state,
        way,
        covariance,
        rotation_weight,
        places.weight,
        left,
        factor,
        moved_by,
        scale,
        predictions,
        maps,
        judged,
    )


def likeliest_level(usual: PoseMode) -> Level:
    """The level of shifts' noise under which closures are likeliest, each by itself, before any of them pulls.

    Odometry that errs by anything has room for every false closure, and they keep it so; taken for better than it is,
    it holds true regions to be wrong. What it tells of closures by itself is a guess at which; −log p decides.

    Args:
        usual: the same labelling, begun with what is believed beforehand.
    """
    problem, told = usual.problem, [usual.first]
    judge = Judge(problem.told, problem.turns, problem.priors)
    for level in _LEVELS[1:]:
        state = _begin(problem, level)
        told.append(_log_likely(problem, _solve(problem, state, _nothing_known(problem, state, judge), judge)))
    return _LEVELS[int(np.argmax(told))]


def _log_likely(problem: PoseProblem, solved: Solved) -> float:
    """Nats, of closures, each by itself, and of the noise."""
    return float(solved.places.log_density.sum()) + log_noise_prior(problem, solved.state.noise)


def _begin(problem: PoseProblem, level: Level) -> PoseState:
    """Orientations by rotations alone, positions along odometry."""
    mode = problem.mode
    common = np.zeros((problem.num_runs, 6))
    if problem.turns_share:
        common[:, :3] = mode.state.common
    nowhere = np.zeros((problem.drawn.num_nodes, 3))
    state = PoseState(mode.state.correction, nowhere, common, problem.turn_noise.of_shifts_times(*level))
    return replace(state, position=problem.along_odometry(problem.displacements(problem.orientations(state))))


def _nothing_known(problem: PoseProblem, state: PoseState, judge: Judge) -> Places:
    closure = problem.mode.problem.closure
    residual = problem.residuals(state, problem.displacements(problem.orientations(state)))
    square = (residual[closure, problem.turns :] ** 2).sum(axis=1)
    return judge.nothing_known(problem.mode.state.is_good[closure], square, _scale(problem, state))


def _scale(problem: PoseProblem, state: PoseState) -> Scale:
    spread = float(np.var(state.position @ problem.bases[1], axis=0).mean())
    good, own = problem.closure_variance(state.noise), problem.own_variance(state.noise)
    return Scale(good, own, state.noise.closure / own, 2 * spread + (_LEAST_EXTENT * problem.typical) ** 2)


def _left_out(factor: BlockFactor, root: np.ndarray, left: np.ndarray, rows: np.ndarray) -> Predictions:
    """What all else says of some rows, whose ``root`` is diagonal, by what is left of them and their leverages."""
    sigma = 1 / np.diagonal(root[rows], axis1=1, axis2=2)
    others, covariance = factor.without(rows)
    mean = sigma * np.matmul(others, left[rows])[:, :, 0]
    return Predictions(mean, sigma[:, :, None] * covariance * sigma[:, None, :])


@dataclass(frozen=True)
class Pace:
    """How far weights of closures go towards what they should be; those that swing go less far.

    Attributes:
        share: ``(2, C)`` of the way, in the logarithm, of weights of shifts and of turns.
        change: ``(2, C)`` by what they were to change.
    """

    share: np.ndarray
    change: np.ndarray

    def towards(self, places: Places, before: Places, at_once: np.ndarray) -> tuple[Places, Pace]:
        """Places with weights between theirs and those before, and the next pace.

        Where a change turns round, the weight has passed the one that stays as it is. By the secant through both
        changes (regula falsi) 1 / (1 − r) of the last share leads there, r < 0 their ratio.

        Args:
            places, before: of C closures.
            at_once: ``(C,)`` bool, which take theirs.
        """
        used = np.stack((before.weight, before.rotation_weight))
        change = np.log(np.stack((places.weight, places.rotation_weight)) / used)
        turns_round = change * self.change < 0
        ratio = change / np.where(turns_round, self.change, 1.0)
        share = np.where(turns_round, np.maximum(self.share / (1 - ratio), _LEAST_SHARE), _SHARE)
        share = np.where(at_once, 1.0, share)
        weight, rotation_weight = used * np.exp(share * change)
        return replace(places, weight=weight, rotation_weight=rotation_weight), Pace(share, change)


def _following(places: Places, problem: PoseProblem, before: PoseNoise, after: PoseNoise) -> Places:
    """With weights that are what they were in those of good closures, of which the variances are others."""
    shift = problem.own_variance(before) / problem.own_variance(after)
    turn = before.closure_turn / after.closure_turn
    return replace(places, weight=places.weight * shift, rotation_weight=places.rotation_weight * turn)


def _settling(chance: np.ndarray, before: np.ndarray, last: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Chances ``(J + 1, C)`` to go on with, and by how much they change: halfway for closures that go to and fro."""
    change = chance - before
    swings = (change * last).sum(axis=0) < 0
    change = np.where(swings, change / 2, change)
    return before + change, change


def _with_noise(
    state: PoseState, noise: np.ndarray, last: np.ndarray, *, is_held: bool
) -> tuple[PoseState, np.ndarray]:
    """The state with other variances, where their sequence leads (Aitken 1926), and by how much they changed.

    Args:
        state: before.
        noise: ``(7,)`` logarithms of variances as estimated.
        last: ``(7,)`` how they changed before; zero where that is not to be gone on from.
        is_held: all but closures' shifts stay.
    """
    before = state.noise.logarithms
    change = noise - before
    change[~_FREE] *= not is_held
    ratio = change * last / np.maximum(last * last, np.finfo(np.float64).tiny)
    goes_on = last != 0
    reached = np.where(goes_on, change / (1 - np.clip(ratio, _LEAST_RATIO, _LARGEST_RATIO)), change)
    reached = before + np.clip(reached, -np.log(_SLOWEST), np.log(_SLOWEST))
    return replace(state, noise=PoseNoise.of(reached)), np.where(goes_on, 0.0, change)
