"""The refinement of a SLAM graph that has grown by a few edges: it goes on from the verdicts and noise of before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.stated_precision import StatedTrust
from rotavg_ros.solver.slam.passes.alternation import Passes, SlamEstimate, Start, Verdicts
from rotavg_ros.solver.slam.passes.system import System, WholeSystem
from rotavg_ros.solver.slam.refinement import estimate

# Passes at most, and when they end: a pass that changes no verdict leaves little to do for another one, if it did not
# turn much. The next update goes on from there.
_MAX_PASSES = 5
_MAX_FOLLOWING_PASSES = 3
_CONVERGED_STEP = np.radians(1.0)
_CONVERGED_PROBABILITY = 0.02
# A graph that turns by more than this is solved as a whole.
_MAX_STEP = np.radians(20.0)


@dataclass(frozen=True, kw_only=True)
class GrownStart(Start):
    """What is known of a graph before its update (K key nodes, E edges), of all edges.

    Attributes:
        prediction_variance: ``(E,)`` rad², of what the rest of the graph predicts of each edge.
    """

    exact_share: np.ndarray
    is_new: np.ndarray
    prediction_variance: np.ndarray


def renew(
    start: GrownStart, rank: np.ndarray | None, trust: StatedTrust, max_step_variance: float
) -> SlamEstimate | None:
    """Factorise, estimate the noise and every edge's prediction anew.

    Args:
        rank: ``(K,)`` order of elimination; None if it is not known.
        trust: how far the variances that closures state are believed; the graph's ``own_steps`` say as much.
        max_step_variance: rad², see :class:`~rotavg_ros.solver.slam.passes.alternation.SlamEstimate`.

    Returns:
        None if orientations turn by so much that all has to be judged anew.
    """
    system = WholeSystem(start.graph, rank)
    state = Passes(start, system, hold_noise=False)
    settled = _alternate(state, max_step_variance, _MAX_PASSES)
    return estimate(state, system, 0.0, trust, max_step_variance) if settled else None


def follow(start: GrownStart, system: System) -> Verdicts | None:
    """The same with noise and predictions as they are known; None likewise.

    Raises:
        StaleFactorError: from the system.
    """
    state = Passes(start, system, hold_noise=True)
    return state.verdicts() if _alternate(state, np.inf, _MAX_FOLLOWING_PASSES) else None


def _alternate(state: Passes, max_step_variance: float, max_passes: int) -> bool:
    """A few passes; False if they do not settle."""
    for _ in range(max_passes):
        moved, changed = state.one_pass(max_step_variance, refresh=state.hold_noise or not state.has_predictions)
        if moved > _MAX_STEP:
            return False
        if moved < _CONVERGED_STEP and changed < _CONVERGED_PROBABILITY:
            break
    return state.has_predictions


def grown_variance(known: np.ndarray, graph: ClosureGraph, weight: np.ndarray) -> np.ndarray:
    """Variance of all nodes ``(N,)``, rad²; of new ones as the best single way from an older one has it.

    Args:
        known: ``(n,)`` of the first n nodes.
        weight: ``(E,)`` of the graph's edges.
    """
    is_known = graph.nodes < len(known)
    at_key = np.full(graph.num_nodes, np.inf)
    at_key[is_known] = known[graph.nodes[is_known]]
    at_key[graph.roots] = 0.0
    edge = np.flatnonzero(~is_known[graph.source] | ~is_known[graph.target])
    ends = np.concatenate((graph.source[edge], graph.target[edge]))
    others = np.concatenate((graph.target[edge], graph.source[edge]))
    variance = np.tile(1 / weight[edge], 2)
    while True:
        better = at_key.copy()
        np.minimum.at(better, ends, at_key[others] + variance)
        better[is_known] = at_key[is_known]
        if np.array_equal(better, at_key):
            break
        at_key = better
    new = slice(len(known), None)
    below, fraction = at_key[graph.below[new]], graph.fraction[new]
    return np.concatenate((known, (1 - fraction) * at_key[graph.above[new]] + fraction * below))
