"""Where else odometry may have slipped: the same turn in another segment may explain the closures nearly as well.

What lies between the two places is then known only up to that turn, which no Gaussian about the likelier answer says.
A slip that is moved from segment a to segment b turns the key nodes between, and only edges with exactly one end among
them notice. So the costs of all places are sums along the chain.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.moves.slip_search import prior_log_odds
from rotavg_ros.solver.slam.moves.truncated_cost import TruncatedCost
from rotavg_ros.solver.slam.noise.model import NoiseModel


def with_moved_slips(
    samples: np.ndarray,
    graph: ClosureGraph,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    log_odds: np.ndarray,
) -> np.ndarray:
    """Samples of the key nodes' errors whose second moments count every slip in all places where it may have been.

    Args:
        samples: ``(K, k)`` rad, if slips are where they were found.
        correction: ``(K, 4)``, with the slips.
        inlier_probability: ``(E,)``; segments below ½ slipped.
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common share of outliers.

    Returns:
        ``(K, k + 2 · slips)`` rad; as they were without slips, or where odometry branches.
    """
    slipped = np.flatnonzero(inlier_probability[: graph.num_segments] < 0.5)
    order = np.argsort(graph.position, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(len(order))
    segment_source, segment_target = rank[graph.source[: graph.num_segments]], rank[graph.target[: graph.num_segments]]
    if len(slipped) == 0 or not np.array_equal(segment_source + 1, segment_target):
        return samples
    follows = np.zeros(len(rank), dtype=bool)
    follows[segment_target] = True
    chain = np.cumsum(~follows)
    cost = TruncatedCost.create(graph, noise, prior_log_odds(graph, noise, log_odds))
    residual = cost.residual(correction)
    costs = cost.of_edges(residual)[:, None]
    turns = residual[torch.from_numpy(slipped)]
    # By how much edges cost more if only their source turns, or only their target; turned back, the other way round.
    if_source = cost.of_cosines(residual @ rotations.inverse(turns).T) - costs
    if_target = cost.of_cosines(residual @ turns.T) - costs
    ends, last = np.stack((rank[graph.source], rank[graph.target])), len(rank) - 1
    columns = []
    for number, segment in enumerate(slipped):
        gap, by_source, by_target = int(segment_source[segment]), if_source[:, number], if_target[:, number]
        # What follows turns back, or what leads there turns along.
        after = _beyond(by_source, by_target, ends, gap + 1, chain)
        before = _beyond(by_target, by_source, last - ends, last - gap, chain[::-1])[::-1]
        square = float((rotations.log(turns[number]) ** 2).sum()) / noise.components
        either = 1.0 + after.max() + before.max()
        columns += [np.sqrt(square / either * moved[rank]) for moved in (after, before)]
    width = samples.shape[1] + len(columns)
    return np.hstack((np.sqrt(width / samples.shape[1]) * samples, np.sqrt(width) * np.stack(columns, axis=1)))


def _beyond(
    if_source: np.ndarray, if_target: np.ndarray, ends: np.ndarray, first: int, chain: np.ndarray
) -> np.ndarray:
    """``(K,)`` by rank: how likely the slip lies beyond a key node, in units of how likely it is where it was found.

    Args:
        if_source, if_target: ``(E,)`` what edges cost more if only this end turns as key nodes between the places do.
        ends: ``(2, E)`` rank of each edge's source and target along the way.
        first: rank of the first key node that turns.
        chain: ``(K,)`` by rank, a number that is the same along one chain.
    """
    num_nodes = len(chain)
    in_reach = ends >= first
    change = np.bincount(ends[0], if_source * in_reach[0], num_nodes)
    change += np.bincount(ends[1], if_target * in_reach[1], num_nodes)
    change -= np.bincount(ends.max(axis=0), (if_source + if_target) * in_reach.all(axis=0), num_nodes)
    # As each key node is the last that turns; the chain's end is no place for a slip.
    more = np.cumsum(change)
    is_place = np.zeros(num_nodes, dtype=bool)
    is_place[first:-1] = (chain[first:-1] == chain[first]) & (chain[first + 1 :] == chain[first])
    likelihood = np.where(is_place, np.exp(-np.maximum(more, 0.0)), 0.0)
    return np.asarray(np.cumsum(likelihood[::-1])[::-1] * (np.arange(num_nodes) >= first))
