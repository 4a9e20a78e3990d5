"""A second opinion on a solution in which odometry was trusted and may have slipped.

A few steps of odometry that are off by tens of degrees (a wheel that spins, a collision) make every closure that
spans them disagree with it, and a solution that trusts the odometry calls them all false. What gives it away is that
neighbouring closures, which do not care how far apart their ends are along the odometry, still agree with each other
(``cycle_votes.py``). Then, and only then, another solution is sought in which segments of the odometry may be wrong.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, shortest_path_forest
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs, agreement_pairs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.moves.cycle_votes import count_votes
from rotavg_ros.solver.slam.moves.jumps import jump_to_optimum
from rotavg_ros.solver.slam.moves.slip_doubt import Doubt
from rotavg_ros.solver.slam.moves.truncated_cost import TruncatedCost
from rotavg_ros.solver.slam.noise.model import (
    NoiseModel,
    agree,
    discrepancies,
    estimate_noise,
    noise_between_neighbours,
)
from rotavg_ros.solver.slam.passes.alternation import SlamEstimate, Start
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.view_graph import ViewGraph

# A step of odometry slips with this probability. Of a long segment only so many count: what is left of it after a slip
# says nothing more, and neither does where in it the slip was.
_SLIP_PROBABILITY = 0.01
_MAX_LOCATED_STEPS = 3.0
# Jumps begin with slips that are half as dear.
_ANNEALED = (0.5, _SLIP_PROBABILITY)
# They take long in larger graphs. Above the first size they begin so only once it is clear that odometry slipped.
_MAX_EDGES_TO_ANNEAL_TWICE = 3000
_MAX_EDGES_TO_JUMP = 20000
# Weight of a closure that its neighbours speak against.
_MIN_TRUST = 1e-3
# A new solution must be better by this many nats, also if false closures come in groups; where doubt is strong, it may
# then lose such a part of what it gains else. It must bring back so many closures more than it gives up: two locate a
# slip, and what brings back none is drift.
_MIN_GAIN = 10.0
_MAX_LOST_SHARE = 0.07
_MIN_REGAINED = 2
_FALSE_SQUARE = np.pi**2 / 3 + 2


def search_for_slips(
    prepared: Prepared, estimate: SlamEstimate, log_odds: np.ndarray, doubt: Doubt, rivals: Sequence[Tensor]
) -> Start | None:
    """A better start than ``estimate``, or None if there is none to be found or no reason to look for one.

    Args:
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
        doubt: in ``estimate``.
        rivals: corrections ``(K, 4)`` of ``estimate`` and other solutions, all of which slips have to outdo.
    """
    if doubt == Doubt.NONE:
        return None
    graph, pairs = prepared.closure_graph, prepared.pairs
    noise = noise_between_neighbours(pairs, prepared.noise.components)
    is_agreed = agree(pairs, noise)
    priors = [prior_log_odds(graph, noise, log_odds, probability) for probability in _ANNEALED]
    finite = np.clip(priors[-1], -50, 50)
    votes = count_votes(graph, pairs, noise, finite[graph.is_closure], finite[: graph.num_segments])
    trust = np.ones(len(graph.source))
    trust[graph.is_closure] = np.maximum(expit(votes.closure), _MIN_TRUST)
    costs = _costs(graph, noise, priors, estimate.rank)
    cost = costs[-1]
    correction = cost.descend(_tree(cost, trust, votes.segment), trust)
    num_edges = len(graph.source)
    if num_edges <= _MAX_EDGES_TO_JUMP:
        first = costs if num_edges <= _MAX_EDGES_TO_ANNEAL_TWICE else costs[-1:]
        correction = jump_through(first, correction, pairs, is_agreed, votes.closure > 0)
    if not _is_better(cost, correction, rivals, pairs, is_agreed, doubt):
        return None
    # Without the slips, the odometry tells how it drifts.
    noise = _noise_without_slips(cost, correction, noise)
    costs = _costs(graph, noise, priors, estimate.rank)
    cost = costs[-1]
    if num_edges <= _MAX_EDGES_TO_JUMP:
        everyone = np.ones(len(votes.closure), dtype=bool)
        correction = jump_through(costs, cost.descend(correction), pairs, is_agreed, everyone)
    return Start(graph, correction, expit(cost.log_odds(correction)), noise, log_odds)


def _costs(
    graph: ClosureGraph, noise: NoiseModel, priors: Sequence[np.ndarray], rank: np.ndarray | None
) -> list[TruncatedCost]:
    """By each prior ``(E,)`` in turn."""
    return [TruncatedCost.create(graph, noise, prior, rank) for prior in priors]


def jump_through(
    costs: Sequence[TruncatedCost],
    correction: Tensor,
    pairs: AgreementPairs,
    is_agreed: np.ndarray,
    is_trusted: np.ndarray,
) -> Tensor:
    """Jumps to an optimum of one cost after the other; corrections ``(K, 4)`` that cost the last no more than given.

    A stretch that turned by itself takes two slips, and its neighbour another: more than a single jump may bring back.
    While slips are cheap, the odometry falls apart as closures want it; then what was not worth its slips is put
    together again.
    """
    found = correction
    for cost in costs:
        found = jump_to_optimum(cost, found, pairs, is_agreed, is_trusted)
    return min(found, correction, key=costs[-1].total)


def _is_better(
    cost: TruncatedCost,
    found: Tensor,
    rivals: Sequence[Tensor],
    pairs: AgreementPairs,
    is_agreed: np.ndarray,
    doubt: Doubt,
) -> bool:
    """Whether corrections ``(K, 4)`` with slips are worth what they cost, beside all ``rivals``."""
    # As far as a descent gets without a search, nothing was found.
    starts = [start for rival in rivals for start in (rival, cost.descend(rival))]
    before = min(starts, key=cost.total)
    gain = cost.total(before) - cost.total(found)
    # A group that all speaks against one step may be a false one that bends the map a little; a descent undoes that.
    compared = starts if doubt == Doubt.AT_A_STEP else rivals
    if_grouped = min(grouped_cost(cost, rival, pairs, is_agreed) for rival in compared)
    enough_if_grouped = -_MAX_LOST_SHARE * gain if doubt >= Doubt.AT_A_STEP else _MIN_GAIN
    believed = [int((cost.log_odds(correction) > 0)[cost.graph.is_closure].sum()) for correction in (before, found)]
    return (
        gain >= _MIN_GAIN
        and if_grouped - grouped_cost(cost, found, pairs, is_agreed) >= enough_if_grouped
        and believed[1] - believed[0] >= _MIN_REGAINED
    )


def prior_log_odds(
    graph: ClosureGraph, noise: NoiseModel, log_odds: np.ndarray, slip_probability: float = _SLIP_PROBABILITY
) -> np.ndarray:
    """``(E,)`` of every edge to be good beforehand: ``log_odds`` ``(E,)`` and what is common to its kind."""
    no_slip = no_slip_log_odds(graph.steps, noise.components, slip_probability)
    return np.asarray(log_odds + np.where(graph.is_odometry, no_slip, noise.prior_log_odds))


def no_slip_log_odds(steps: np.ndarray, components: int, slip_probability: float = _SLIP_PROBABILITY) -> np.ndarray:
    """Log-odds of segments to be good beforehand, a slip being less than a right angle and as likely to be any.

    Args:
        slip_probability: of one step.
    """
    narrower = np.log(2.0) if components == 1 else np.log(2 / (1 - np.cos(np.pi / 4)))
    none = np.log1p(-slip_probability) * np.minimum(steps, _MAX_LOCATED_STEPS)
    return np.asarray(none - np.log(-np.expm1(none)) - narrower)


def grouped_cost(cost: TruncatedCost, correction: Tensor, pairs: AgreementPairs, is_agreed: np.ndarray) -> float:
    """The cost of a solution ``(K, 4)`` if wrong closures that agree with each other have one reason to be wrong."""
    costs, closure = cost.of_edges(cost.residual(correction)), cost.graph.is_closure
    wrong = costs[closure] > 0.5 * cost.cap[closure]
    agreeing = np.bincount(pairs.first, is_agreed & wrong[pairs.second], len(wrong))
    return float(costs[~closure].sum() + (costs[closure] / np.where(wrong, 1 + agreeing, 1.0)).sum())


def _noise_without_slips(cost: TruncatedCost, correction: Tensor, noise: NoiseModel) -> NoiseModel:
    """The noise as closures and an odometry tell it whose slips are taken out as ``correction`` ``(K, 4)`` has them."""
    graph = cost.graph
    source, target = torch.from_numpy(graph.source), torch.from_numpy(graph.target)
    slipped = torch.from_numpy((cost.log_odds(correction) < 0) & graph.is_odometry)[:, None]
    turn = rotations.multiply(correction[target], rotations.inverse(correction[source]))
    chain = torch.where(slipped, turn, graph.residual)
    repaired = ViewGraph.create(graph.source, graph.target, chain, num_nodes=graph.num_nodes)
    forest = shortest_path_forest(repaired, torch.where(torch.from_numpy(graph.is_odometry), 1.0, 1e6), root="first")
    odometry = compose_orientations(forest, repaired)
    residual = edge_residual(odometry, graph.residual, source, target)
    closure = torch.from_numpy(graph.is_closure)
    square = (rotations.log(residual[closure]) ** 2).sum(dim=1).numpy()
    pairs = agreement_pairs(replace(graph, residual=residual))
    found = estimate_noise(discrepancies(square, graph.path_steps[graph.is_closure], pairs), noise.components)
    # What odometry takes for its own of the closures' noise would be lost to them; none is better than a step.
    return replace(found, closure_variance=max(found.closure_variance, found.step_variance))


def _tree(cost: TruncatedCost, trust: np.ndarray, segment_log_odds: np.ndarray) -> Tensor:
    """Corrections ``(K, 4)`` along the tree of least expected squared error."""
    graph = cost.graph
    doubt = 1 - trust
    doubt[: graph.num_segments] = expit(-segment_log_odds)
    doubt = np.maximum(doubt, np.where(graph.is_closure, _MIN_TRUST, 0.0))
    closure_graph = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
    length = torch.from_numpy(cost.variance + doubt * _FALSE_SQUARE)
    return compose_orientations(shortest_path_forest(closure_graph, length, root="first"), closure_graph)
