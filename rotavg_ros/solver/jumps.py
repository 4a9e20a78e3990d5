"""Turning whole parts of a closure graph at once, where no small step leads to a better solution.

If odometry slipped, everything after the slip is turned by the same rotation. A *jump* takes the residual of one wrong
edge and turns the best set of nodes by it: which nodes go along is a minimum cut, since every edge between those that
do and those that do not pays or gains. (The expansion moves of Boykov, Veksler & Zabih 2001, with a rotation for a
label; where such a move is not submodular, its cost is taken from above, so an accepted jump is an improvement.)
"""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array, csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_flow
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.agreement import AgreementPairs
from rotavg_ros.solver.truncated_cost import TruncatedCost

_MAX_ROUNDS = 3
_MAX_CANDIDATES = 40
# An improvement by less than this many nats is none.
_MIN_GAIN = 0.5
# scipy's maximum flow counts in integers.
_UNIT = 1000.0


def jump_to_optimum(
    cost: TruncatedCost, correction: Tensor, pairs: AgreementPairs, is_agreed: np.ndarray, is_trusted: np.ndarray
) -> Tensor:
    """Jumps and descents in turn until neither helps; corrections ``(K, 4)``.

    Args:
        correction: ``(K, 4)`` start.
        pairs: neighbouring closures; of those that agree one stands for all.
        is_agreed: ``(P,)`` bool, the pairs that agree.
        is_trusted: ``(C,)`` bool, closures whose residual is worth a jump.
    """
    for _ in range(_MAX_ROUNDS):
        jumped, gained = _round_of_jumps(cost, correction, pairs, is_agreed, is_trusted)
        if gained < _MIN_GAIN:
            break
        correction = min(jumped, cost.descend(jumped), key=cost.total)
    return correction


def _round_of_jumps(
    cost: TruncatedCost, correction: Tensor, pairs: AgreementPairs, is_agreed: np.ndarray, is_trusted: np.ndarray
) -> tuple[Tensor, float]:
    """One jump by each wrong edge that still is one when its turn comes; corrections and the cost saved."""
    residual = cost.residual(correction)
    costs = cost.of_edges(residual)
    gained = 0.0
    for edge in _candidates(cost, costs, pairs, is_agreed, is_trusted):
        if costs[edge] < 0.5 * cost.cap[edge]:
            continue
        moves = _best_set(cost, residual, residual[edge], costs)
        moved = torch.from_numpy(np.flatnonzero(moves))
        if len(moved) in (0, len(moves)):
            continue
        tried = correction.clone()
        # Norms multiply with every jump; rounding errors would, too.
        tried[moved] = rotations.normalize(rotations.multiply(correction[moved], residual[edge].expand(len(moved), 4)))
        tried_residual = cost.residual(tried)
        tried_costs = cost.of_edges(tried_residual)
        gain = float(costs.sum() - tried_costs.sum())
        if gain > _MIN_GAIN:
            correction, residual, costs = tried, tried_residual, tried_costs
            gained += gain
    return correction, gained


def _candidates(
    cost: TruncatedCost, costs: np.ndarray, pairs: AgreementPairs, is_agreed: np.ndarray, is_trusted: np.ndarray
) -> np.ndarray:
    """Wrong segments, and of every group of wrong closures that agree with each other the best supported one."""
    closure = np.flatnonzero(cost.graph.is_closure)
    is_wrong = (costs > 0.5 * cost.cap) & (cost.cap > 0)
    wrong = is_wrong[closure] & is_trusted
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


def _best_set(cost: TruncatedCost, residual: Tensor, turn: Tensor, costs: np.ndarray) -> np.ndarray:
    """``(K,)`` bool: the nodes to turn by ``turn`` ``(4,)``, by a minimum cut."""
    source, target, num_nodes = cost.graph.source, cost.graph.target, cost.graph.num_nodes
    # Real parts of turn⁻¹ ∘ residual and of residual ∘ turn.
    if_target, if_source = cost.of_cosines(residual @ turn), cost.of_cosines(residual @ rotations.inverse(turn))
    # Submodularity asks that turning one end or the other costs no less than turning neither or both.
    bound = 2 * costs
    raise_source = if_target < if_source
    if_source, if_target = (
        np.where(raise_source, np.maximum(if_source, bound - if_target), if_source),
        np.where(raise_source, if_target, np.maximum(if_target, bound - if_source)),
    )
    # A labelling x ∈ {0 stays, 1 turns} costs, up to a constant,
    # Σ (if_source − c)(x_u − x_v) + (if_source + if_target − 2c)(1 − x_u) x_v.
    unary = np.bincount(source, if_source - costs, num_nodes) - np.bincount(target, if_source - costs, num_nodes)
    pair = if_source + if_target - bound
    stays, turns = num_nodes, num_nodes + 1
    nodes = np.arange(num_nodes)
    capacity = np.concatenate((pair, np.maximum(unary, 0), np.maximum(-unary, 0)))
    rows = np.concatenate((source, np.full(num_nodes, stays), nodes))
    columns = np.concatenate((target, nodes, np.full(num_nodes, turns)))
    units = np.rint(_UNIT * capacity).astype(np.int32)
    network = csr_array(coo_array((units, (rows, columns)), shape=(num_nodes + 2,) * 2))
    network.sum_duplicates()
    network.eliminate_zeros()
    left = csr_array(network - maximum_flow(network, stays, turns).flow)
    left.eliminate_zeros()
    reached = breadth_first_order(left, stays, return_predecessors=False)
    moves = np.ones(num_nodes + 2, dtype=bool)
    moves[reached] = False
    return moves[:num_nodes]
