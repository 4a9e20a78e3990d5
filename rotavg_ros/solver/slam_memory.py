"""What a SLAM solve remembers for the next one of the same graph, grown by a handful of edges.

A node's tick that judged ten thousand closures need not judge them from nothing when five more have come: their
verdicts, the noise and the order of elimination are still right. New closures are judged by their company as ever;
then a few passes of the refinement go on from where the last ones ended. All closures are judged again in these, so
that a verdict can still change; when several do, or the graph has grown by some percent, or some number of updates
later, the whole solve runs again, and with it the search for slips and biases.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver import slam_refinement
from rotavg_ros.solver.agreement import NUM_NEIGHBOURS, agreement_pairs, closure_ends
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.common_error import RUN_GAP_STEPS
from rotavg_ros.solver.noise_model import NoiseModel
from rotavg_ros.solver.slam_clean_net import SlamCleanNet
from rotavg_ros.solver.slam_passes import SlamEstimate
from rotavg_ros.solver.slam_stages import CleanedClosures, Prepared, draw_together, judge_closures
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# The whole solve runs again after so many updates, or once there are so many more closures.
_MAX_UPDATES = 60
_MAX_GROWTH = 0.05
# Closures whose verdict may turn in an update, and what share of all.
_MAX_TURNED, _MAX_SHARE_TURNED = 2, 0.002
# With fewer closures than this, the whole solve takes no longer than an update.
_MIN_CLOSURES = 200
_COLUMNS = ("source", "target", "target_from_source", "kind", "label", "steps")


@dataclass(frozen=True)
class SlamMemory:
    """Of a graph of M edges.

    Attributes:
        graph: the view-graph.
        inlier_probability: ``(M,)`` that an edge is not a false one; all of a segment have that of the segment.
        prior_log_odds: ``(M,)`` what the network said of closures.
        steps: ``(M,)`` variance of a closure in units of the closures'; more than 1 where neighbours err together.
        exact_share: ``(M,)`` probability of a good closure to err no more than most.
        chain_noise: the noise as the odometry has it.
        noise: the noise as the refinement left it.
        max_step_variance: rad², as the refinement kept it.
        elimination: ``(K,)`` nodes in the order of elimination.
        closures: how many there were when the whole solve ran.
        updates: how many there have been since.
    """

    graph: ViewGraph
    inlier_probability: np.ndarray
    prior_log_odds: np.ndarray
    steps: np.ndarray
    exact_share: np.ndarray
    chain_noise: NoiseModel
    noise: NoiseModel
    max_step_variance: float
    elimination: np.ndarray
    closures: int
    updates: int = 0

    @classmethod
    def of(
        cls, graph: ViewGraph, prepared: Prepared, cleaned: CleanedClosures, estimate: SlamEstimate
    ) -> SlamMemory | None:
        """After a whole solve; None where an update could not go on from it."""
        closures = int(prepared.closure_graph.is_closure.sum())
        if closures < _MIN_CLOSURES or prepared.is_unbiased or estimate.rank is None:
            return None
        return cls._of(graph, prepared.closure_graph, cleaned.prior_log_odds, prepared.noise, estimate, closures, 0)

    @classmethod
    def _of(
        cls,
        graph: ViewGraph,
        closure_graph: ClosureGraph,
        prior_log_odds: np.ndarray,
        chain_noise: NoiseModel,
        estimate: SlamEstimate,
        closures: int,
        updates: int,
    ) -> SlamMemory:
        assert estimate.rank is not None
        return cls(
            graph,
            closure_graph.edge_values(estimate.inlier_probability),
            closure_graph.edge_values(prior_log_odds),
            closure_graph.edge_values(estimate.steps),
            closure_graph.edge_values(estimate.exact_share),
            chain_noise,
            estimate.noise,
            estimate.max_step_variance,
            closure_graph.nodes[np.argsort(estimate.rank)],
            closures,
            updates,
        )

    def updated(
        self, graph: ViewGraph, network: SlamCleanNet | None, body_from_world: torch.Tensor
    ) -> tuple[ClosureGraph, SlamEstimate, SlamMemory] | None:
        """Solve a graph that has grown from this one; None if it has not, or the whole solve should run.

        Args:
            body_from_world: ``(N, 4)`` start.
        """
        if self.updates >= _MAX_UPDATES or not _begins_with(graph, self.graph):
            return None
        num_closures = int((~graph.is_odometry).sum())
        if num_closures > (1 + _MAX_GROWTH) * self.closures:
            return None
        closure_graph, _ = draw_together(graph)
        start = self._start(closure_graph, network)
        estimate = slam_refinement.update(
            replace(closure_graph, steps=start.steps),
            closure_graph.corrections(body_from_world),
            start.inlier_probability,
            self.noise,
            start.prior_log_odds,
            self.max_step_variance,
            self._rank(closure_graph),
            self._extended(self.exact_share, closure_graph, 1.0),
        )
        if estimate is None:
            return None
        turned = np.abs(estimate.inlier_probability - start.inlier_probability) > 0.5
        turned[start.new_closures] = False
        if turned.sum() > max(_MAX_TURNED, _MAX_SHARE_TURNED * num_closures):
            return None
        numbers = self.chain_noise, estimate, self.closures, self.updates + 1
        return closure_graph, estimate, self._of(graph, closure_graph, start.prior_log_odds, *numbers)

    def _extended(self, value: np.ndarray, closure_graph: ClosureGraph, otherwise: float) -> np.ndarray:
        """Values ``(M,)`` of this graph's edges → those of a larger one's closure graph ``(E,)``; a segment's least."""
        of_edge = np.full(len(closure_graph.segment_of_edge), otherwise)
        of_edge[: len(value)] = value
        out = np.full(len(closure_graph.source), otherwise)
        on_segment = closure_graph.segment_of_edge >= 0
        np.minimum.at(out, closure_graph.segment_of_edge[on_segment], of_edge[on_segment])
        out[closure_graph.num_segments :] = of_edge[closure_graph.view_graph_edge]
        return out

    def _start(self, graph: ClosureGraph, network: SlamCleanNet | None) -> _Start:
        """What is known of all edges, and of new closures what those around them say."""
        inlier_probability = self._extended(self.inlier_probability, graph, 1.0)
        prior = self._extended(self.prior_log_odds, graph, 0.0)
        closure = np.flatnonzero(graph.is_closure)
        steps = graph.steps.copy()
        steps[closure] = self._extended(self.steps, graph, 1.0)[closure]
        is_new = graph.view_graph_edge[closure - graph.num_segments] >= self.graph.num_edges
        new = closure[is_new]
        if len(new) == 0:
            return _Start(inlier_probability, prior, steps, new)
        ends = closure_ends(graph, closure)
        tree = KDTree(ends, balanced_tree=False, compact_nodes=False)
        distance, neighbour = tree.query(ends[is_new], k=NUM_NEIGHBOURS + 1, p=1)
        # Where closures err together, the new one errs as that next to it.
        is_near = ~is_new[neighbour] & (distance <= RUN_GAP_STEPS)
        nearest = np.take_along_axis(neighbour, is_near.argmax(axis=1)[:, None], axis=1)[:, 0]
        steps[new] = np.where(is_near.any(axis=1), steps[closure[nearest]], 1.0)
        # Messages run from neighbour to neighbour; what is farther than two rounds away hardly counts.
        around = np.unique(neighbour)
        around = np.union1d(around, tree.query(ends[around], k=NUM_NEIGHBOURS + 1, p=1)[1])
        chosen = closure[around]
        squared_angle = (rotations.log(graph.residual[torch.from_numpy(chosen)]) ** 2).sum(dim=1).numpy()
        log_odds, of_network = judge_closures(
            network, self.chain_noise, squared_angle, graph.path_steps[chosen], agreement_pairs(graph, chosen)
        )
        judged = is_new[around]
        inlier_probability[new], prior[new] = expit(log_odds[judged]), of_network[judged]
        return _Start(inlier_probability, prior, steps, new)

    def _rank(self, graph: ClosureGraph) -> np.ndarray:
        """Order of elimination ``(K,)``: as it was, and what is new comes last."""
        place = np.full(len(graph.odometry_orientation), np.iinfo(np.int64).max)
        place[self.elimination] = np.arange(len(self.elimination))
        rank = np.empty(graph.num_nodes, dtype=np.int64)
        rank[np.argsort(place[graph.nodes], kind="stable")] = np.arange(graph.num_nodes)
        return rank


class _Start(NamedTuple):
    """``(E,)`` probabilities of being good, prior log-odds and variances in units of the kind's; the new closures."""

    inlier_probability: np.ndarray
    prior_log_odds: np.ndarray
    steps: np.ndarray
    new_closures: np.ndarray


def _begins_with(graph: ViewGraph, earlier: ViewGraph) -> bool:
    """Whether all edges of ``earlier`` come first in ``graph``, as they were, and of the others none has a label."""
    count = earlier.num_edges
    if count > graph.num_edges or bool((graph.label[count:] != EdgeLabel.AUTOMATIC).any()):
        return False
    return all(torch.equal(getattr(graph, name)[:count], getattr(earlier, name)) for name in _COLUMNS)
