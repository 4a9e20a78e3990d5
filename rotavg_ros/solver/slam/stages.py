"""The stages of a SLAM solve, shared by the pipeline and by training."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import compose_orientations, shortest_path_forest
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.network import SlamCleanNet, closure_features, false_log_odds
from rotavg_ros.solver.slam.noise.model import NoiseModel, judge_by_chain
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# For the tree: the least probability that a closure is false, and the mean squared error, rad², of a false one.
_MIN_DISTRUST = 0.02
_FALSE_SQUARE = 3 * rotations.RANDOM_VARIANCE
# Share of the network's log-odds that the posterior adds to its own: only a part, since both use some of the same
# evidence; less the more closures are false, since agreement by chance is then as common as agreement of good ones.
_NETWORK_SHARE = 0.6
_MAX_NETWORK_LOG_ODDS = 4.0
# Units of work for each closure that the network judges.
_JUDGED = 0.013


@dataclass(frozen=True)
class CleanedClosures:
    """What is known of the E edges of a closure graph before the search.

    Attributes:
        inlier_probability: ``(E,)``; 1 for odometry, unless a user has rejected it.
        network_log_odds: ``(E,)`` log-odds of being good, used in the posterior's prior; ±inf by label.
    """

    inlier_probability: np.ndarray
    network_log_odds: np.ndarray


def clean(network: SlamCleanNet | None, prepared: Prepared, label: Tensor) -> CleanedClosures:
    """Judge every closure by its discrepancy with the odometry and, with a network, by the closures that agree with it.

    A closure starts as good only if both criteria say so: false closures may agree with each other, and odometry that
    has drifted far is compatible with anything. The network's log-odds also enter the posterior's prior.

    Args:
        label: ``(M,)`` labels of the view-graph's edges.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    prior = np.zeros(len(graph.source))
    good = np.full(len(graph.source), np.inf)
    good[graph.is_closure], prior[graph.is_closure] = judge_closures(
        network, noise, prepared.squared_angle, prepared.path_steps, prepared.pairs
    )
    told = label.numpy()
    # A segment may slip in any step but those that a user has accepted.
    on_segment = graph.segment_of_edge >= 0
    is_open = told[on_segment] != EdgeLabel.ACCEPTED
    may_slip = np.bincount(graph.segment_of_edge[on_segment], is_open, minlength=graph.num_segments) > 0
    prior[: graph.num_segments][~may_slip] = np.inf
    edge_label = told[graph.view_graph_edge]
    verdict = np.select([edge_label == EdgeLabel.ACCEPTED, edge_label == EdgeLabel.REJECTED], [np.inf, -np.inf], 0.0)
    good[graph.num_segments :] = np.where(verdict == 0, good[graph.num_segments :], verdict)
    prior[graph.num_segments :] = np.where(verdict == 0, prior[graph.num_segments :], verdict)
    return CleanedClosures(expit(good), prior)


def judge_closures(
    network: SlamCleanNet | None,
    noise: NoiseModel,
    squared_angle: np.ndarray,
    path_steps: np.ndarray,
    pairs: AgreementPairs,
) -> tuple[np.ndarray, np.ndarray]:
    """Log-odds ``(C,)`` that closures are good, before the search, and those for the posterior's prior."""
    by_chain = judge_by_chain(noise, squared_angle, path_steps) + noise.prior_log_odds
    if network is None or len(by_chain) == 0:
        return by_chain, np.zeros(len(by_chain))
    spend(_JUDGED * len(by_chain))
    by_network = -false_log_odds(network, closure_features(noise, squared_angle, path_steps, pairs)).double().numpy()
    bounded = np.clip(by_network, -_MAX_NETWORK_LOG_ODDS, _MAX_NETWORK_LOG_ODDS)
    return np.minimum(by_chain, by_network), _NETWORK_SHARE * (1 - noise.outlier_share) * bounded


def bootstrap(prepared: Prepared, cleaned: CleanedClosures) -> Tensor:
    """Corrections ``(K, 4)`` along the tree of least expected squared error.

    A step of odometry costs its variance; a closure costs its own variance plus the squared error of a false one times
    its probability of being false. So the tree follows the odometry until its drift exceeds a trusted closure's error.
    Odometry that a user has rejected costs what a false closure does.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    distrust = np.maximum(1 - cleaned.inlier_probability, np.where(graph.is_odometry, 0.0, _MIN_DISTRUST))
    variance = np.where(graph.is_odometry, graph.own_steps * noise.step_variance, noise.closure_variance)
    cost = variance + distrust * _FALSE_SQUARE
    closure_graph = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
    forest = shortest_path_forest(closure_graph, torch.from_numpy(cost), root="first")
    return compose_orientations(forest, closure_graph)


def outlier_scores(graph: ClosureGraph, outlier_probability: np.ndarray, of_restated: np.ndarray | float) -> np.ndarray:
    """Probability that each edge of the view-graph is wrong, ``(M,)``, from those of the closure graph, ``(E,)``.

    A slip in a segment is equally likely in any of its steps. ``of_restated`` are those of closures that are made of
    odometry, one for all or ``(n,)``.
    """
    return np.asarray(graph.edge_values(outlier_probability, of_restated) * graph.share_of_segment)
