"""The stages of a SLAM solve, as the pipeline runs them and as training sees them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.agreement import AgreementPairs, agreement_pairs
from rotavg_ros.solver.closure_graph import ClosureGraph, contract
from rotavg_ros.solver.noise_model import NoiseModel, discrepancies, estimate_noise, judge_by_chain
from rotavg_ros.solver.slam_clean_net import SlamCleanNet, closure_features
from rotavg_ros.solver.spanning_tree import compose_orientations, minimum_spanning_forest, shortest_path_forest
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Odometry first: no number of steps is worth a closure.
_CLOSURE_COST = 1e6
# What a closure's verdict counts for in the tree: nobody is trusted beyond this, and a false one is off by about this.
_MIN_DISTRUST = 0.02
_FALSE_SQUARE = np.pi**2 / 3 + 2
# Rotations whose axes spread less than this (relative) are all about one axis.
_PLANAR_SPREAD = 1e-10


@dataclass(frozen=True)
class Prepared:
    """A SLAM graph drawn together, with the scale of its noise (C closures).

    Attributes:
        closure_graph: the graph of the closures' ends.
        squared_angle: ``(C,)`` rad², discrepancy of each closure with the odometry.
        path_steps: ``(C,)`` odometry steps between its ends; inf where odometry does not connect them.
        pairs: which closures agree.
        noise: estimated scales.
    """

    closure_graph: ClosureGraph
    squared_angle: np.ndarray
    path_steps: np.ndarray
    pairs: AgreementPairs
    noise: NoiseModel

    @property
    def num_segments(self) -> int:
        return self.closure_graph.num_segments


def prepare(graph: ViewGraph) -> Prepared:
    """Contract the odometry chains and estimate the noise of steps and closures. Rejected edges take no part."""
    usable = graph.label != EdgeLabel.REJECTED
    cost = torch.where(graph.is_odometry, 1.0, _CLOSURE_COST)
    # A rejected edge may only be used where nothing else connects.
    forest = minimum_spanning_forest(graph, torch.where(usable, cost, _CLOSURE_COST**2))
    closure_graph = contract(graph, forest)
    closure = closure_graph.is_closure
    squared_angle = (rotations.log(closure_graph.residual) ** 2).sum(dim=1).numpy()[closure]
    path_steps = closure_graph.path_steps[closure]
    pairs = agreement_pairs(closure_graph)
    noise = estimate_noise(discrepancies(squared_angle, path_steps, pairs), rotation_components(graph))
    return Prepared(closure_graph, squared_angle, path_steps, pairs, noise)


@dataclass(frozen=True)
class CleanedClosures:
    """Verdicts on the E edges of a closure graph before the global solve.

    Attributes:
        inlier_probability: ``(E,)``; 1 for odometry.
        prior_log_odds: ``(E,)`` log-odds of being good that the refinement adds to its own evidence; ±inf by label.
    """

    inlier_probability: np.ndarray
    prior_log_odds: np.ndarray


def clean(network: SlamCleanNet | None, prepared: Prepared, label: Tensor) -> CleanedClosures:
    """Judge every closure by its discrepancy with the odometry and, with a network, by the company it keeps.

    A closure starts as good only if both say so: a group of false closures agrees with itself, and odometry that has
    drifted far believes anything.

    Args:
        label: ``(M,)`` of the view-graph's edges.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    prior = np.zeros(len(graph.source))
    good = np.full(len(graph.source), np.inf)
    by_chain = judge_by_chain(noise, prepared.squared_angle, prepared.path_steps) + noise.prior_log_odds
    good[graph.is_closure] = by_chain
    if network is not None and len(by_chain):
        features = closure_features(noise, prepared.squared_angle, prepared.path_steps, prepared.pairs)
        good[graph.is_closure] = np.minimum(by_chain, -network(features).double().numpy())
    edge_label = label.numpy()[graph.view_graph_edge]
    verdict = np.select([edge_label == EdgeLabel.ACCEPTED, edge_label == EdgeLabel.REJECTED], [np.inf, -np.inf], 0.0)
    good[graph.num_segments :] = np.where(verdict == 0, good[graph.num_segments :], verdict)
    prior[graph.num_segments :] = np.where(verdict == 0, prior[graph.num_segments :], verdict)
    return CleanedClosures(expit(good), prior)


def bootstrap(prepared: Prepared, cleaned: CleanedClosures) -> Tensor:
    """Corrections ``(K, 4)`` along the tree of least expected squared error.

    A step of odometry costs its variance; a closure costs its own and, as far as it is not trusted, what a false
    one would do. So the tree follows the odometry until that has drifted farther than a trusted closure errs.
    """
    graph, noise = prepared.closure_graph, prepared.noise
    distrust = np.maximum(1 - cleaned.inlier_probability, _MIN_DISTRUST)
    cost = np.where(
        graph.is_odometry, graph.steps * noise.step_variance, noise.closure_variance + distrust * _FALSE_SQUARE
    )
    closure_graph = ViewGraph.create(graph.source, graph.target, graph.residual, num_nodes=graph.num_nodes)
    forest = shortest_path_forest(closure_graph, torch.from_numpy(cost), root="first")
    return compose_orientations(forest, closure_graph)


def rotation_components(graph: ViewGraph) -> int:
    """1 if all measured rotations share one axis (planar motion), else 3."""
    vectors = rotations.log(graph.target_from_source)
    spread = torch.linalg.eigvalsh(vectors.T @ vectors)
    return 1 if float(spread[1]) <= _PLANAR_SPREAD * float(spread[2]) else 3
