"""A second opinion on a solution in which odometry was trusted and may have slipped.

A few steps of odometry that are off by tens of degrees (a wheel that spins, a collision) make every closure that
spans them disagree with it, and a solution that trusts the odometry calls them all false. What gives it away is that
neighbouring closures, which do not care how far apart their ends are along the odometry, still agree with each other
(``cycle_votes.py``). Then, and only then, another solution is sought in which segments of the odometry may be wrong,
from two starts, and the one of lower cost is taken.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros.solver.agreement import AgreementPairs
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.cycle_votes import count_votes
from rotavg_ros.solver.jumps import jump_to_optimum
from rotavg_ros.solver.noise_model import NoiseModel, noise_between_neighbours
from rotavg_ros.solver.slam_refinement import SlamEstimate
from rotavg_ros.solver.spanning_tree import compose_orientations, shortest_path_forest
from rotavg_ros.solver.truncated_cost import TruncatedCost
from rotavg_ros.view_graph import ViewGraph

# A segment slips with this probability, however long it is: a slip that is not located cannot be acted upon.
_SLIP_PROBABILITY = 3e-3
_OUTLIER_SHARE = 0.3
# The solution is doubted if this share of what at least so many neighbours agree upon is rejected by it,
_DOUBTED_SHARE = 0.7
_MIN_SUPPORTERS = 2
# or if, of a map that explains most closures, so much larger a share disagrees with the odometry.
_DOUBTED_DIFFERENCE = 0.05
_MOST = 0.6
# In larger graphs loops are dense; there annealing alone finds the slips, and jumps take long.
_MAX_EDGES_TO_JUMP = 3000
# Weight of a closure that its neighbours speak against.
_MIN_TRUST = 1e-3
# A new solution must be better by this many nats.
_MIN_GAIN = 10.0
_FALSE_SQUARE = np.pi**2 / 3 + 2


@dataclass(frozen=True)
class SlipStart:
    """Where to refine from: corrections ``(K, 4)``, probabilities of being good ``(E,)``, and noise."""

    correction: Tensor
    inlier_probability: np.ndarray
    noise: NoiseModel


def search_for_slips(
    graph: ClosureGraph,
    pairs: AgreementPairs,
    estimate: SlamEstimate,
    by_chain: NoiseModel,
    log_odds: np.ndarray,
) -> SlipStart | None:
    """A better start than ``estimate``, or None if there is none to be found or no reason to look for one.

    Args:
        by_chain: the noise as it looks if odometry never slips.
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
    """
    good = estimate.inlier_probability[graph.is_closure]
    if len(pairs.first) == 0 or not _is_doubtful(pairs, good, by_chain):
        return None
    noise = noise_between_neighbours(pairs, by_chain.components)
    is_agreed = _agree(pairs, noise)
    prior = log_odds + np.where(
        graph.is_odometry, np.log1p(-_SLIP_PROBABILITY) - np.log(_SLIP_PROBABILITY), noise.prior_log_odds
    )
    finite = np.clip(prior, -50, 50)
    votes = count_votes(graph, pairs, noise, finite[graph.is_closure], finite[: graph.num_segments])
    trust = np.ones(len(graph.source))
    trust[graph.is_closure] = np.maximum(expit(votes.closure), _MIN_TRUST)
    cost = TruncatedCost.create(graph, noise, prior)
    correction = cost.descend(_tree(cost, trust, votes.segment), trust)
    if len(graph.source) <= _MAX_EDGES_TO_JUMP:
        starts = (correction, estimate.correction)
        found = [jump_to_optimum(cost, start, pairs, is_agreed, votes.closure > 0) for start in starts]
        correction = min(found, key=cost.total)
    if cost.total(correction) > cost.total(estimate.correction) - _MIN_GAIN:
        return None
    return SlipStart(correction, expit(cost.log_odds(correction)), noise)


def _is_doubtful(pairs: AgreementPairs, good: np.ndarray, by_chain: NoiseModel) -> bool:
    """Whether closures that agree are rejected, or the map explains closures that the odometry does not."""
    supporters = np.bincount(pairs.first, _agree(pairs, by_chain), len(good))
    # A group of false closures agrees with itself; it must not outvote the rest by its size.
    weight = np.where(supporters >= _MIN_SUPPORTERS, 1 / (1 + supporters), 0.0)
    rejected = good < 0.5
    rejected_share = float((weight * rejected).sum() / max(weight.sum(), 1e-12))
    if rejected_share > _DOUBTED_SHARE:
        return True
    explained = by_chain.outlier_share - float(rejected.mean())
    return explained > _DOUBTED_DIFFERENCE and float(rejected.mean()) < _MOST


def _agree(pairs: AgreementPairs, noise: NoiseModel) -> np.ndarray:
    """``(P,)`` bool."""
    variance = np.maximum(pairs.steps, 0.5) * noise.step_variance + 2 * noise.closure_variance
    return noise.inlier_log_odds(pairs.squared_angle, variance) > 0


def _tree(cost: TruncatedCost, trust: np.ndarray, segment_log_odds: np.ndarray) -> Tensor:
    """Corrections ``(K, 4)`` along the tree of least expected squared error."""
    graph = cost.graph
    doubt = 1 - trust
    doubt[: graph.num_segments] = expit(-segment_log_odds)
    doubt = np.maximum(doubt, np.where(graph.is_closure, _MIN_TRUST, 0.0))
    closure_graph = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
    length = torch.from_numpy(cost.variance + doubt * _FALSE_SQUARE)
    return compose_orientations(shortest_path_forest(closure_graph, length, root="first"), closure_graph)
