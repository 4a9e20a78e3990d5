"""Starts of a search: CleanNet's tree, closures annealed on odometry of several qualities, ℓ½, minimum cuts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, shortest_path_forest
from rotavg_ros.solver.slam.graph.evenly import evenly
from rotavg_ros.solver.slam.noise.model import NoiseModel, agree, noise_between_neighbours
from rotavg_ros.solver.slam.posterior.em import settle
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.moves.jumps import jump_to_optimum
from rotavg_ros.solver.slam.posterior.moves.truncated_cost import TruncatedCost, no_slip_log_odds
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import moved, residuals, variances
from rotavg_ros.solver.slam.posterior.state import (
    COMMON_SHARES,
    EXPONENTS,
    RUN_STEPS,
    Noise,
    Others,
    State,
)
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.solver.slam.stages import CleanedClosures
from rotavg_ros.view_graph import ViewGraph

# The 99 % quantile of χ² in k components, beyond which truncated least squares counts no inliers.
_INLIER_SQUARE = {1: 6.63, 3: 11.34}
# Annealing has ended once the loss is as sharp as this.
_SHARP = 1e3
# Step deviations this many prior standard deviations above (below) the median are tried, with closures half a one below
# it. In this order starts agree soonest on the likeliest answer: good odometry and extremely bad odometry come first,
# since those in between often end alike, with nearly all closures held false.
_STEP_LEVELS, _CLOSURE_LEVEL = (1.0, 4.0, -1.0, 0.0, 2.0), -0.5
# ρ(r) = |r|^½ beyond a standard deviation: weights are (1 + r²/σ²)^-¾.
_ROBUST_POWER = -0.75
# Probabilities of a slip per step under which parts are turned, beginning with one at which slips cost nothing.
_ANNEALED_SLIPS = (0.5, 0.01)
_LEAST_WEIGHT = 1e-9
# Closures between two chains agree if their turns differ by less than this, rad, to allow for the chains' drift.
_SAME_TURN = np.radians(15.0)
# Maximum number of closures between two chains of which it is counted how many agree with each.
_MAX_TRIED = 256


def starts(problem: Problem, prepared: Prepared, cleaned: CleanedClosures, tree: Tensor) -> Iterator[tuple[str, State]]:
    """Name and state of each start that is switched on, generated lazily; the tree is always among them.

    Args:
        problem: the graph.
        prepared: the contracted graph.
        cleaned: CleanNet's verdict on its closures.
        tree: corrections ``(K, 4)`` along CleanNet's tree, or of an earlier answer.
    """
    noise, everything = initial_noise(prepared.noise), _all_good(problem)
    yield "tree", settle(problem, at(problem, tree, cleaned.inlier_probability, noise))
    if "robust-start" not in problem.without:
        yield "robust start", _robust(problem, at(problem, tree, everything, noise))
    if "annealing" not in problem.without:
        joined = _joined_chains(problem)
        for step_variance, closure_variance in _prior_levels(problem.priors):
            level = replace(noise, step_variance=step_variance, closure_variance=closure_variance)
            yield "annealing", annealed(problem, at(problem, tree if joined is None else joined, everything, level))


def turned_parts(problem: Problem, prepared: Prepared, tree: Tensor) -> State:
    """A state with parts turned by minimum cuts where odometry seems to have slipped, with labels that then follow."""
    near = noise_between_neighbours(prepared.pairs, problem.components)
    found = _turned_parts(problem, prepared, tree, near)
    return _labelled(problem, at(problem, found, _all_good(problem), initial_noise(near)))


def turned_further(problem: Problem, prepared: Prepared, state: State) -> State:
    """A state with further parts turned: two pairs of slips may turn two parts alike, which no single move undoes."""
    noise = NoiseModel(
        problem.components, state.noise.step_variance, state.noise.closure_variance, prepared.noise.outlier_share
    )
    correction = torch.from_numpy(np.ascontiguousarray(state.correction.T))
    found = _turned_parts(problem, prepared, correction, noise, anneal=False)
    return _labelled(problem, at(problem, found, _all_good(problem), state.noise))


def initial_noise(model: NoiseModel) -> Noise:
    """θ to begin with: the model's variances, without stated precisions, common errors, turns or tails."""
    return Noise(model.step_variance, model.closure_variance, EXPONENTS[0], COMMON_SHARES[1], RUN_STEPS[0])


def at(problem: Problem, correction: Tensor, trusted: np.ndarray, noise: Noise) -> State:
    """A state at corrections ``(K, 4)``, with labels ``(E,)``; those that a user has set hold."""
    rows = np.ascontiguousarray(correction.numpy().T)
    common = np.zeros((problem.system(noise).num_runs, 3))
    trusted = problem.allowed(trusted.astype(np.float64))
    return State(rows, common, trusted, noise, Others.before_any(len(problem.graph.source)))


def _all_good(problem: Problem) -> np.ndarray:
    """Labels ``(E,)`` of which all are good."""
    return np.ones(len(problem.graph.source))


def annealed(problem: Problem, state: State) -> State:
    """Graduated non-convexity (Yang et al. 2020, truncated least squares) on closures, odometry trusted."""
    variance, closure, system = variances(problem, state.noise), problem.closure, problem.system(state.noise)
    may_count = problem.log_odds[closure] > -np.inf
    limit = _INLIER_SQUARE[problem.components]
    sharpness = 0.0
    while sharpness < _SHARP:
        residual = residuals(problem, state)
        square = (residual**2).sum(axis=1)[closure] / variance[closure]
        if sharpness == 0:
            largest = float(square.max(initial=0.0, where=may_count))
            sharpness = limit / max(2 * largest - limit, _LEAST_WEIGHT)
        else:
            weight = np.sqrt(limit * sharpness * (sharpness + 1) / np.maximum(square, _LEAST_WEIGHT)) - sharpness
            trusted = state.trusted.copy()
            trusted[closure] = np.clip(weight, 0.0, 1.0)
            state = replace(state, trusted=problem.allowed(trusted))
            sharpness *= problem.limits.annealing_factor
        trust = np.concatenate((state.trusted, np.ones(system.num_runs)))
        state = moved(state, system.factorise(np.maximum(trust, _LEAST_WEIGHT) / variance).fit(residual))
    return replace(state, trusted=state.is_good.astype(np.float64))


def _prior_levels(priors: SlamPriors) -> list[tuple[float, float]]:
    """Step and closure variances, rad², that are likely under the prior."""
    closure = np.radians(priors.closure_deg * np.exp(_CLOSURE_LEVEL * priors.noise_spread)) ** 2
    steps = np.radians(priors.step_deg * np.exp(priors.noise_spread * np.array(_STEP_LEVELS))) ** 2
    return [(float(step), float(closure)) for step in steps]


def _joined_chains(problem: Problem) -> Tensor | None:
    """Corrections ``(K, 4)`` that turn each chain of odometry as a whole, to agree with the closures between chains.

    None if no closure joins two chains. Between two chains the turn is used that most closures agree with, and chains
    are joined along a tree that prefers pairs with many agreeing closures.
    """
    graph, closure = problem.graph, problem.closure
    _, chain = np.unique(graph.chain, return_inverse=True)
    ends = np.stack((chain[graph.source[closure]], chain[graph.target[closure]]))
    between = np.flatnonzero((ends[0] != ends[1]) & (problem.log_odds[closure] > -np.inf))
    if len(between) == 0:
        return None
    # A closure u → v between chains says C_v ≈ e C_u for all nodes of both; all are stated from the lower chain on.
    turned = problem.measured[:, closure[between]]
    turned = np.where(ends[0, between] < ends[1, between], turned, quaternion_rows.inverse(turned))
    low, high = np.sort(ends[:, between], axis=0)
    count = int(chain.max()) + 1
    pair = low * count + high
    order = np.argsort(pair, kind="stable")
    most = [_agreed_by_most(turned, of) for of in np.split(order, np.flatnonzero(np.diff(pair[order])) + 1)]
    best, votes = np.array(most).T
    chains = ViewGraph.create(low[best], high[best], torch.from_numpy(turned[:, best].T.copy()), num_nodes=count)
    forest = shortest_path_forest(chains, torch.from_numpy(1.0 / votes**2), root="first")
    return compose_orientations(forest, chains)[torch.from_numpy(chain)]


def _agreed_by_most(turned: np.ndarray, closures: np.ndarray) -> tuple[int, int]:
    """Which of some closures ``(n,)`` most of them agree with, and with how many; ``turned`` is ``(4, C)``."""
    tried = evenly(closures, _MAX_TRIED)
    votes = (np.abs(turned[:, tried].T @ turned[:, closures]) > np.cos(_SAME_TURN / 2)).sum(axis=1)
    best = int(votes.argmax())
    return int(tried[best]), int(votes[best])


def _robust(problem: Problem, state: State) -> State:
    """Iteratively reweighted least squares with an ℓ½-like loss on all edges alike, odometry included."""
    own = variances(problem, state.noise)
    for _ in range(problem.limits.robust_solves):
        residual = residuals(problem, state)
        weight = (1 + (residual**2).sum(axis=1) / own) ** _ROBUST_POWER / own
        weight[: len(state.trusted)] *= np.maximum(state.trusted, _LEAST_WEIGHT)
        state = moved(state, problem.system(state.noise).factorise(weight).fit(residual))
    return _labelled(problem, state)


def _turned_parts(
    problem: Problem, prepared: Prepared, correction: Tensor, model: NoiseModel, *, anneal: bool = True
) -> Tensor:
    """Parts turned by minimum cuts under a truncated cost, first with cheap slips; corrections ``(K, 4)``."""
    graph, pairs = problem.graph, prepared.pairs
    is_agreed = agree(pairs, model)
    for number, probability in enumerate(_ANNEALED_SLIPS):
        no_slip = no_slip_log_odds(graph.own_steps, problem.components, probability)
        prior = np.where(graph.is_odometry, no_slip, model.prior_log_odds) + problem.log_odds
        cost = TruncatedCost.create(graph, model, prior)
        if number == 0 and anneal:
            correction = cost.anneal(correction)
        correction = jump_to_optimum(cost, correction, pairs, is_agreed)
    # A part may have been turned with its root, even a whole component that nothing ties to others.
    return graph.from_roots(correction)


def _labelled(problem: Problem, state: State) -> State:
    """The state with each label set to the one that its residual favours."""
    return replace(state, common=np.zeros_like(state.common), trusted=relabelled(problem, state))
