"""A robot's noise, estimated from one of its runs; and how well FineNets predict stretches of it that are held back."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.optimize import nnls
from scipy.special import polygamma

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import PASSES, Tuned, applied
from rotavg_ros.solver.slam.posterior.densities import log_false, log_good
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.rows import residuals, tails

# Edges whose own noise is a smaller part of the discrepancy's variance than this are not used.
_TOLD = 0.5
# With fewer edges of a kind, differences between them are not estimated.
_LEAST_EDGES = 6
# Closures are held back in stretches: maximum number of stretches, and least number of closures in one.
_STRETCHES, _IN_STRETCH = 16, 6
# Number of solves after closures are held back.
_SOLVES = 4
# False closures repeat each other's turn if they agree within this, rad.
_SAME_TURN = np.radians(5.0)
_LEAST_SHARE = 0.02
# Least part of a step's variance that is not due to turns. Where they explain nearly all, least squares may leave none.
_LEAST_APART = 0.1


@dataclass(frozen=True)
class RobotNoise:
    """The noise of one run. Angles are root mean squares of a rotation's angle, all components together.

    Attributes:
        keyframes: number of keyframes.
        planar: whether all rotations are about one axis.
        odometry_deg: typical error of a step, without what it errs more by because it turns.
        closure_deg: typical error of a good closure.
        closures_per_keyframe: number of closures per keyframe.
        false_share: share of the closures that are false.
        grouped_share: share of the false ones that agree with another one, beyond chance.
        step_spread: standard deviation of the logarithm of odometry's error from segment to segment.
        closure_spread: the same for good closures, from one to the next.
        per_turn: error of odometry over the angle by which a step turns; 0 if errors do not depend on it.
        common_share: share of good closures' variance that those of a run have in common; 0 if they err independently.
        states_precision: whether stated precisions of closures are informative.
    """

    keyframes: int
    planar: bool
    odometry_deg: float
    closure_deg: float
    closures_per_keyframe: float
    false_share: float
    grouped_share: float
    step_spread: float
    closure_spread: float
    per_turn: float
    common_share: float
    states_precision: bool


def robot_noise(mode: Mode, network: SlamFineNet, truth: np.ndarray | None = None) -> RobotNoise:
    """The noise of a run, from its likeliest labelling.

    Args:
        mode: the labelling, without FineNet.
        network: FineNet.
        truth: ``(4, K)`` true corrections, from which errors are computed; default: discrepancies from the prediction
            by all others are used.
    """
    problem, state = mode.problem, mode.state
    evidence = Evidence.of(problem, state)
    if truth is not None:
        true_state = replace(state, correction=truth, common=np.zeros_like(state.common))
        error = residuals(problem, true_state)[: len(evidence.own)]
        evidence = replace(evidence, square=(error**2).sum(axis=1), predicted=np.zeros(len(error)))
    odometry, k, noise = evidence.is_odometry, evidence.components, state.noise
    usual = [evidence.own[kind] * _level(evidence, kind) for kind in (odometry, ~odometry)]
    steps = np.maximum(evidence.steps[odometry], 1.0)
    of_step = k * float(np.median(usual[0] / steps))
    per_turn = 0.0
    if noise.turn_share > 0:
        apart, per_turn = _by_turns(mode, evidence)
        of_step = float(np.clip(apart, _LEAST_APART * of_step, of_step)) if per_turn > 0 else of_step
    is_false = ~evidence.is_good[~odometry]
    closures = max(len(is_false), 1)
    return RobotNoise(
        keyframes=len(problem.graph.above),
        planar=k == 1,
        odometry_deg=float(np.degrees(np.sqrt(of_step))),
        closure_deg=float(np.degrees(np.sqrt(k * np.median(usual[1])))) if len(usual[1]) else 0.0,
        closures_per_keyframe=len(is_false) / len(problem.graph.above),
        false_share=float(is_false.sum()) / closures,
        grouped_share=_grouped(mode),
        step_spread=_spread_along(mode, network),
        closure_spread=_spread(evidence, ~odometry),
        per_turn=per_turn,
        common_share=noise.common_share if noise.run_steps > 0 else 0.0,
        states_precision=noise.exponent > 0,
    )


def held_back(mode: Mode, networks: Sequence[SlamFineNet | None]) -> np.ndarray:
    """``(B, n)`` nats per closure: log density of the closures of B stretches, predicted by all others with n networks.

    Each closure is good with the probability 1 − share of false ones, else false. FineNet affects the prediction only.

    Args:
        mode: labelling of a whole run.
        networks: the networks to compare; None stands for no FineNet.
    """
    problem, closure = mode.problem, mode.problem.closure
    count = min(_STRETCHES, len(closure) // _IN_STRETCH)
    stretches = np.array_split(problem.detection, count) if count > 1 else []
    rows = np.zeros((len(stretches), len(networks)))
    for row, stretch in zip(rows, stretches, strict=True):
        trusted = mode.state.trusted.copy()
        trusted[closure[stretch]] = 0.0
        state, evaluation = polish(problem, replace(mode.state, trusted=trusted), _SOLVES, hold_noise=True)
        without = Tuned(problem, state, evaluation.factorised)
        for number, network in enumerate(networks):
            tuned = without
            for _ in range(0 if network is None else PASSES):
                assert network is not None
                tuned = applied(network, tuned)
            row[number] = _density(mode, tuned, closure[stretch]).mean()
    return rows


def _density(mode: Mode, tuned: Tuned, edges: np.ndarray) -> np.ndarray:
    """``(n,)`` nats, log densities of closures that were held back."""
    problem, noise, k = tuned.problem, tuned.state.noise, tuned.problem.components
    evidence = Evidence.of(problem, tuned.state)
    square, predicted = evidence.square[edges], evidence.predicted[edges]
    shared = problem.system(noise).shared[edges] * noise.common_share * noise.closure_variance
    own = evidence.own[edges] * np.exp(-evidence.log_relative[edges]) + shared
    tailed = tails(problem, mode.state.noise).of(edges)
    good = log_good(square, own, predicted, k, tailed)[0]
    share = float(np.clip(mode.is_false.mean(), _LEAST_SHARE, 1 - _LEAST_SHARE))
    false = log_false(square, k, problem.priors, predicted=predicted)
    return np.asarray(np.logaddexp(np.log1p(-share) + good, np.log(share) + false))


def _standardised(evidence: Evidence, kind: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """For good edges of a kind: z², and the part of its expectation that is due to their own noise."""
    total = evidence.own + evidence.predicted
    used = kind & evidence.is_good
    return (evidence.square / (evidence.components * total))[used], (evidence.own / total)[used]


def _level(evidence: Evidence, kind: np.ndarray) -> float:
    """Ratio of the typical variance to the estimated one: the median of z² over the median of its distribution."""
    square, told = _standardised(evidence, kind)
    clear = square[told > _TOLD]
    if len(clear) < _LEAST_EDGES:
        return 1.0
    k = evidence.components
    # The median of χ² over its degrees of freedom (Wilson and Hilferty 1931).
    return float(np.median(clear)) / (1 - 2 / (9 * k)) ** 3


def _spread(evidence: Evidence, kind: np.ndarray) -> float:
    """Standard deviation of log σ, from the variance of log z² beyond that of χ²."""
    square, told = _standardised(evidence, kind)
    clear = square[told > _TOLD]
    if len(clear) < _LEAST_EDGES:
        return 0.0
    beyond = np.log(np.maximum(clear, 1e-4)).var() - float(polygamma(1, evidence.components / 2))
    return float(np.sqrt(max(beyond, 0.0))) / 2


def _spread_along(mode: Mode, network: SlamFineNet) -> float:
    """The same for odometry, from segment to segment by FineNet's variances, weighted by their steps."""
    tuned = applied(network, applied(network, Tuned(mode.problem, mode.state, mode.evaluation.factorised)))
    relative, graph = tuned.problem.relative, mode.problem.graph
    assert relative is not None
    used = graph.is_odometry & mode.state.is_good
    level, steps = np.log(relative[used]) / 2, graph.own_steps[used]
    middle = np.average(level, weights=steps)
    return float(np.sqrt(np.average((level - middle) ** 2, weights=steps)))


def _by_turns(mode: Mode, evidence: Evidence) -> tuple[float, float]:
    """Squared error of a step that does not turn, rad², and error over angle of what turns add; 0 and 0 if unknown.

    By non-negative least squares of squared errors on steps and squared turns.
    """
    problem = mode.problem
    segments = np.flatnonzero(evidence.is_odometry & evidence.is_good & (evidence.own > evidence.predicted))
    segments = segments[segments < problem.graph.num_segments]
    if problem.turned is None or len(segments) < _LEAST_EDGES:
        return 0.0, 0.0
    graph = problem.graph
    turned = problem.turned[graph.nodes]
    square = np.maximum(turned[graph.target[segments]] - turned[graph.source[segments]], 0.0)
    # Relative to the expected squares; otherwise the largest would decide alone.
    unit = evidence.components * (evidence.own + evidence.predicted)[segments]
    left = (evidence.square[segments] - evidence.components * evidence.predicted[segments]) / unit
    causes = np.stack((graph.own_steps[segments], square), axis=1) / unit[:, None]
    scale = causes.mean(axis=0) + 1e-300
    apart, added = nnls(causes / scale, left)[0] / scale
    return float(apart), float(np.sqrt(added))


def _grouped(mode: Mode) -> float:
    """Share of the false closures that agree with another one, minus what random turns would give, rescaled to 0–1."""
    problem = mode.problem
    false = np.flatnonzero(mode.is_false)
    if len(false) < 2:
        return 0.0
    residual = mode.evaluation.residual[problem.closure[false]] * problem.sign[false, None]
    turn = quaternion_rows.exp(np.ascontiguousarray(residual.T))
    cosine = np.abs(turn.T @ turn)
    np.fill_diagonal(cosine, 0.0)
    agree = float((cosine.max(axis=1) > np.cos(_SAME_TURN / 2)).mean())
    # Probability that a random rotation is nearer than that to a given one.
    near = _SAME_TURN / np.pi if problem.components == 1 else (_SAME_TURN - np.sin(_SAME_TURN)) / np.pi
    chance = 1 - (1 - near) ** (len(false) - 1)
    return float(max(0.0, (agree - chance) / (1 - chance)))
