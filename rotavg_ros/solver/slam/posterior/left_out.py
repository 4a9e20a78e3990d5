"""Leave-one-out log-odds and scores of each edge, given the rest of the graph; and labels by residuals alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.special import expit

from rotavg_ros.solver.running.work import rest
from rotavg_ros.solver.slam.noise.exceedance import OUTLIER_ANGLE, exceedance
from rotavg_ros.solver.slam.posterior.densities import beyond, log_false, log_good, log_slipped
from rotavg_ros.solver.slam.posterior.labels.false_closures import Discrepancies, false_density, if_false, log_false_set
from rotavg_ros.solver.slam.posterior.labels.prior import label_log_odds, log_label_prior, log_slip_odds
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.rows import residuals, sites, tails, variances, with_others
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.posterior.system import Factorised

# Log-odds of labels that a user has set.
CERTAIN = 1e6


@dataclass(frozen=True)
class LeftOut:
    """What the rest of the graph says of every edge (E edges).

    Attributes:
        log_odds: ``(E,)`` log-odds of being good, or of not having slipped: the rise of F if the label flips.
        square: ``(E,)`` rad², squared discrepancy from the prediction by the rest.
        predicted: ``(E,)`` rad², variance of that prediction.
        if_good: ``(E,)`` nats, log density of the edge as a good one.
        unrepeated: ``(E,)`` log-odds of closures if no false one repeated another's turn.
    """

    log_odds: np.ndarray
    square: np.ndarray
    predicted: np.ndarray
    if_good: np.ndarray
    unrepeated: np.ndarray


def leave_one_out(problem: Problem, state: State, factorised: Factorised) -> LeftOut:
    """What the rest of the graph says of every edge, given the labels of all others."""
    rest()
    graph, k, priors, closure = problem.graph, problem.components, problem.priors, problem.closure
    num_edges = len(graph.source)
    residual, variance = residuals(problem, state), variances(problem, state.noise)
    own = variance[:num_edges]
    told = with_others(state, factorised, state.others.relative / own, own, k)
    site = sites(problem, told, residual, variance)
    square, predicted = site.square, site.predicted

    # The prior's log-odds, minus the log density of the edge if it is not good.
    odds = problem.log_odds.copy()
    is_false = ~state.is_good[closure]
    told_false, alone = if_false(problem, is_false, Discrepancies.of(problem, told, residual))
    label_odds = label_log_odds(problem, is_false)
    odds[closure] = label_odds - np.log(told_false)
    odometry = np.flatnonzero(graph.is_odometry)
    slipped = ~state.is_good[odometry]
    odds[odometry] -= log_slip_odds(problem, graph.own_steps[odometry], slipped.sum() - slipped)
    odds[odometry] -= log_slipped(square[odometry], own[odometry], predicted[odometry], k, priors)

    if_good = log_good(k * (own + predicted), own, predicted, k, tails(problem, state.noise))[0]
    log_odds = site.log_density + odds
    unrepeated = log_odds.copy()
    unrepeated[closure] = site.log_density[closure] + label_odds - np.log(alone)
    return LeftOut(log_odds, square, predicted, if_good, unrepeated)


def scores(problem: Problem, state: State, left_out: LeftOut) -> tuple[np.ndarray, np.ndarray]:
    """``(E,)`` probability that an edge's noise exceeds 10° or that a segment slipped, and how far the edge is trusted.

    The trust, a factor of the weight, is the probability that an edge is good and its noise below 10°. So edges that
    are published as false do not influence the answer.
    """
    closure, k = problem.closure, problem.components
    good = expit(left_out.log_odds)
    square, predicted = left_out.square, left_out.predicted
    # A shared error is part of a closure's noise, too.
    shared = problem.system(state.noise).shared[: len(good)]
    total = variances(problem, state.noise)[: len(good)]
    total = total + shared * state.noise.common_share * state.noise.closure_variance
    exceeds = beyond(OUTLIER_ANGLE, square, total, predicted, k, tails(problem, state.noise))
    otherwise = np.ones(len(good))
    otherwise[closure] = exceedance(np.sqrt(square[closure]), predicted[closure], OUTLIER_ANGLE, k)
    return good * exceeds + (1 - good) * otherwise, good * (1 - exceeds)


def slipped_or_tailed(problem: Problem, state: State, left_out: LeftOut) -> np.ndarray:
    """Edges of odometry that slipped, or are in its tails with a probability above one half."""
    own = variances(problem, state.noise)[: len(left_out.square)]
    tailed = tails(problem, state.noise)
    _, usual = log_good(left_out.square, own, left_out.predicted, problem.components, tailed)
    return np.flatnonzero(problem.graph.is_odometry & (~state.is_good | (usual < 1 - usual)))


def relabelled(problem: Problem, state: State) -> np.ndarray:
    """``(E,)`` 1 for edges that their current residuals favour, else 0."""
    good, otherwise = _log_densities(problem, state)
    return np.asarray(good > otherwise, dtype=np.float64)


def rough_cost(problem: Problem, state: State) -> float:
    """F without the integrals over corrections, nats: from current residuals and labels, false closures jointly."""
    good, otherwise = _log_densities(problem, state)
    closure, is_false = problem.closure, ~state.is_good[problem.closure]
    odometry = problem.graph.is_odometry
    told = np.where(state.is_good, good, otherwise)[odometry].sum() + good[closure[~is_false]].sum()
    told -= np.clip(problem.log_odds, -CERTAIN, CERTAIN)[closure[~is_false]].sum()  # counted with the labels
    off = Discrepancies.of(problem, state, residuals(problem, state))
    density = false_density(problem, is_false, off, np.flatnonzero(is_false))
    return -float(told) - log_false_set(problem, density) - log_label_prior(problem, is_false)


def _log_densities(problem: Problem, state: State) -> tuple[np.ndarray, np.ndarray]:
    """``(E,)`` each: log densities of edges if good, and if not, by residuals and the prior."""
    graph, k, priors, closure = problem.graph, problem.components, problem.priors, problem.closure
    num_edges = len(graph.source)
    without_common = replace(state, common=np.zeros_like(state.common))
    square = (residuals(problem, without_common) ** 2).sum(axis=1)[:num_edges]
    own = variances(problem, state.noise)[:num_edges]
    slack = np.where(graph.is_odometry, 0.0, state.noise.closure_variance)
    good = log_good(square, own, slack, k, tails(problem, state.noise))[0]
    good += np.clip(problem.log_odds, -CERTAIN, CERTAIN)
    otherwise = np.empty(num_edges)
    otherwise[closure] = log_false(square[closure], k, priors)
    odometry = np.flatnonzero(graph.is_odometry)
    otherwise[odometry] = log_slipped(square[odometry], own[odometry], 0.0, k, priors)
    otherwise[odometry] += log_slip_odds(problem, graph.own_steps[odometry], 1)
    return good, otherwise
