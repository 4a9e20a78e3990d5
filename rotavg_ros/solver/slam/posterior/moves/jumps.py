"""Turns whole parts of a closure graph at once, where no small step leads to a better solution.

If odometry slipped, everything after the slip is turned by the same rotation. A *jump* takes the residual of one wrong
edge and turns the best set of nodes by it. That set is a minimum cut, since every edge between a turned and an unturned
node changes its cost. (The expansion moves of Boykov, Veksler & Zabih 2001, with a rotation for a label; where such a
move is not submodular, its cost is bounded from above, so an accepted jump is an improvement.)
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.minimum_cut import FlowNetwork, TwoLabels
from rotavg_ros.solver.running.work import stop_if_abandoned
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.posterior.moves.truncated_cost import TruncatedCost

_MAX_ROUNDS = 3
_MAX_CANDIDATES = 40
# Least improvement that counts, nats.
_MIN_GAIN = 0.5
# Conductance of maximally wrong edges in the electrical flow, which thus avoids them.
_MIN_CARRIED = 1e-6


def jump_to_optimum(cost: TruncatedCost, correction: Tensor, pairs: AgreementPairs, is_agreed: np.ndarray) -> Tensor:
    """Alternates jumps and descents until neither helps; corrections ``(K, 4)``.

    Args:
        correction: ``(K, 4)`` start.
        pairs: neighbouring closures; one represents all that agree with each other.
        is_agreed: ``(P,)`` bool, the pairs that agree.
    """
    jumps = _Jumps(cost, pairs, is_agreed)
    for _ in range(_MAX_ROUNDS):
        jumped, gained = jumps.one_round(correction)
        if gained < _MIN_GAIN:
            break
        correction = min(jumped, cost.descend(jumped), key=cost.total)
    return correction


class _Jumps:
    """Rounds of jumps under one cost; the arguments are those of :func:`jump_to_optimum`."""

    def __init__(self, cost: TruncatedCost, pairs: AgreementPairs, is_agreed: np.ndarray) -> None:
        self._cost, self._pairs, self._is_agreed = cost, pairs, is_agreed
        # ``(E,)`` nats, bound on the gain of each edge's jump when it was last tried without success.
        self._hopeless = np.zeros(len(cost.cap))
        self._network = FlowNetwork(cost.graph.num_nodes, cost.graph.source, cost.graph.target)

    def one_round(self, correction: Tensor) -> tuple[Tensor, float]:
        """Tries the jump of each edge that is still wrong in its turn; corrections ``(K, 4)``, and the gain in nats."""
        cost, hopeless = self._cost, self._hopeless
        residual = cost.residual(correction)
        costs = cost.of_edges(residual)
        gained = 0.0
        candidates = _candidates(cost, costs, self._pairs, self._is_agreed)
        if len(candidates) == 0:
            return correction, gained
        # If one end turns, an edge's cost rises at most by its distance from the cap.
        system = cost.pattern.factorize(np.maximum(cost.cap - costs, _MIN_CARRIED))
        questions = turns(cost, residual, residual[candidates], costs)
        bounds = questions.gain_bounds(system)
        for number in np.flatnonzero(bounds > hopeless[candidates] + _MIN_GAIN):
            stop_if_abandoned()
            edge = candidates[number]
            if costs[edge] < 0.5 * cost.cap[edge]:
                continue
            # Until a jump is accepted, all minimum-cut problems stay as they were set up.
            question, column, bound = questions, int(number), float(bounds[number])
            if gained > 0:
                question, column = turns(cost, residual, residual[[edge]], costs), 0
                bound = float(question.gain_bounds(system)[0])
                if bound <= hopeless[edge] + _MIN_GAIN:
                    continue
            hopeless[edge] = bound
            moved = torch.from_numpy(np.flatnonzero(question.best_set(self._network, system, column)))
            if len(moved) in (0, cost.graph.num_nodes):
                continue
            tried = correction.clone()
            # Normalised, since every jump would multiply the rounding errors of the norms.
            tried[moved] = rotations.normalize(
                rotations.multiply(correction[moved], residual[edge].expand(len(moved), 4))
            )
            tried_residual = cost.residual(tried)
            tried_costs = cost.of_edges(tried_residual)
            gain = float(costs.sum() - tried_costs.sum())
            if gain > _MIN_GAIN:
                correction, residual, costs = tried, tried_residual, tried_costs
                gained += gain
                hopeless[edge] = 0.0
        return correction, gained


def _candidates(cost: TruncatedCost, costs: np.ndarray, pairs: AgreementPairs, is_agreed: np.ndarray) -> np.ndarray:
    """Wrong segments, and the closure with most agreeing ones from each group of wrong closures that agree."""
    closure = np.flatnonzero(cost.graph.is_closure)
    is_wrong = (costs > 0.5 * cost.cap) & (cost.cap > 0)
    wrong = is_wrong[closure]
    linked = is_agreed & wrong[pairs.first] & wrong[pairs.second]
    links = coo_array(
        (np.ones(int(linked.sum())), (pairs.first[linked], pairs.second[linked])), shape=(len(wrong),) * 2
    )
    group = connected_components(links, directed=False)[1]
    support = np.bincount(pairs.first[linked], minlength=len(wrong))
    members = np.flatnonzero(wrong)
    members = members[np.lexsort((-support[members], group[members]))]
    group_size = np.bincount(group[members], minlength=len(wrong) + 1)
    leaders = members[np.unique(group[members], return_index=True)[1]]
    leaders = leaders[np.argsort(-group_size[group[leaders]], kind="stable")][:_MAX_CANDIDATES]
    segments = np.flatnonzero(is_wrong & cost.graph.is_odometry)
    return np.concatenate((segments, closure[leaders]))


def turns(cost: TruncatedCost, residual: Tensor, turns: Tensor, costs: np.ndarray) -> TwoLabels:
    """The minimum-cut problems for turning nodes by each of ``turns`` ``(Q, 4)``.

    Args:
        cost: the cost.
        residual: ``(E, 4)`` current residuals.
        turns: ``(Q, 4)`` turns.
        costs: ``(E,)`` current costs.
    """
    graph = cost.graph
    # Real parts of turn⁻¹ ∘ residual and of residual ∘ turn.
    if_target = cost.of_cosines(residual @ turns.T)
    if_target -= costs[:, None]
    if_source = cost.of_cosines(residual @ rotations.inverse(turns).T)
    if_source -= costs[:, None]
    return TwoLabels.create(graph.num_nodes, graph.source, graph.target, if_target, if_source)
