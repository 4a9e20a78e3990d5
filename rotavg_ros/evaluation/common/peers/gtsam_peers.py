"""GTSAM's Shonan averaging, its graduated non-convexity, and its iSAM2 with robust losses.

Its values are world_from_body. The robust ones are told that odometry is right: it is their start, and no loss
softens it.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from scipy.stats import chi2
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.baselines.start import depths, solve_by_component, spanning_forest, start_orientations
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.peers.running import INLIER_PROBABILITY, from_rows, load, stated_sigma, timed
from rotavg_ros.view_graph import ViewGraph

# Thresholds in standard deviations, for 95 % efficiency under Gaussian noise (Holland & Welsch 1977).
_HUBER_THRESHOLD = 1.345
_CAUCHY_THRESHOLD = 2.3849
# Where Geman–McClure's weight is a quarter: the residual that GNC calls an outlier's.
_GEMAN_MCCLURE_THRESHOLD = float(np.sqrt(chi2.ppf(INLIER_PROBABILITY, 3)))
# Standard deviation of the prior on the first node of a component, rad.
_ANCHOR_SIGMA = 1e-4
# Shonan lifts to rotations of at most this dimension before it gives up on a certificate.
_SHONAN_MAX_DIMENSION = 10


def shonan(graph: ViewGraph) -> Answer:
    """GTSAM's Shonan averaging: the certifiably optimal least-squares solution, without robustness.

    It is told the stated precisions, and neither a start nor which edges are odometry.
    """
    gtsam = load("gtsam")
    clock = Clock()

    def solve_connected(part: ViewGraph, _: Tensor | None) -> Tensor:
        noise = _noise_models(gtsam, part)
        edges = zip(part.source.tolist(), part.target.tolist(), _source_from_target(gtsam, part), noise, strict=True)
        averaging = gtsam.ShonanAveraging3(
            [gtsam.BinaryMeasurementRot3(*edge) for edge in edges],
            gtsam.ShonanAveragingParameters3(gtsam.LevenbergMarquardtParams.CeresDefaults()),
        )
        with timed(clock):
            values, _ = averaging.run(averaging.initializeRandomly(), 3, _SHONAN_MAX_DIMENSION)
        return _body_from_world(values, part.num_nodes)

    return Answer(solve_by_component(graph, None, solve_connected), clock.seconds, clock.cpu_seconds)


def gnc(graph: ViewGraph) -> Answer:
    """GTSAM's graduated non-convexity (truncated least squares).

    It is told the stated precisions, that odometry is an inlier, and odometry's orientations as the start.
    """
    gtsam = load("gtsam")
    forest = spanning_forest(graph)
    factors = gtsam.NonlinearFactorGraph()
    for factor in _between_factors(gtsam, graph):
        factors.add(factor)
    for root in forest.roots.tolist():
        factors.add(_anchor(gtsam, root))
    parameters = gtsam.GncLMParams()
    parameters.setLossType(gtsam.GncLossType.TLS)
    anchors = range(graph.num_edges, graph.num_edges + len(forest.roots))
    parameters.setKnownInliers([*torch.nonzero(graph.is_odometry).flatten().tolist(), *anchors])
    optimizer = gtsam.GncLMOptimizer(factors, _start_values(gtsam, graph), parameters)
    optimizer.setInlierCostThresholdsAtProbability(INLIER_PROBABILITY)
    clock = Clock()
    with timed(clock):
        values = optimizer.optimize()
    # A weight is 1 for an inlier and 0 for an outlier where the annealing has ended.
    score = torch.from_numpy(1 - np.asarray(optimizer.getWeights())[: graph.num_edges])
    return Answer(_body_from_world(values, graph.num_nodes), clock.seconds, clock.cpu_seconds, score)


def isam2_huber(graph: ViewGraph) -> Answer:
    """iSAM2 with Huber's loss on closures; see :func:`_isam2` for what it is told."""
    gtsam = load("gtsam")
    return _isam2(gtsam, graph, gtsam.noiseModel.mEstimator.Huber.Create(_HUBER_THRESHOLD))


def isam2_cauchy(graph: ViewGraph) -> Answer:
    """iSAM2 with Cauchy's loss on closures; see :func:`_isam2` for what it is told."""
    gtsam = load("gtsam")
    return _isam2(gtsam, graph, gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY_THRESHOLD))


def isam2_geman_mcclure(graph: ViewGraph) -> Answer:
    """iSAM2 with Geman–McClure's loss on closures; see :func:`_isam2` for what it is told."""
    gtsam = load("gtsam")
    return _isam2(gtsam, graph, gtsam.noiseModel.mEstimator.GemanMcClure.Create(_GEMAN_MCCLURE_THRESHOLD))


def _isam2(gtsam: Any, graph: ViewGraph, loss: Any) -> Answer:
    """GTSAM's iSAM2 with its default parameters, one update per node in the order of the odometry.

    It is told the stated precisions and which edges are odometry: a node starts where odometry leads from the estimate
    so far, and odometry keeps the square loss.
    """
    forest = spanning_forest(graph)
    depth = depths(forest)
    order = np.argsort(depth, kind="stable")
    rank = np.empty_like(order)
    rank[order] = np.arange(graph.num_nodes)
    # An edge arrives with the later of its ends.
    arrival = np.maximum(rank[graph.source.numpy()], rank[graph.target.numpy()])
    edges_by_arrival = np.argsort(arrival, kind="stable")
    bounds = np.searchsorted(arrival[edges_by_arrival], np.arange(graph.num_nodes + 1))
    factors = _between_factors(gtsam, graph, loss)
    start = _start_values(gtsam, graph)
    isam = gtsam.ISAM2(gtsam.ISAM2Params())
    clock = Clock()
    for step, node in enumerate(order.tolist()):
        added, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        for edge in edges_by_arrival[bounds[step] : bounds[step + 1]].tolist():
            added.add(factors[edge])
        parent = int(forest.parent[node])
        with timed(clock):
            if parent == node:
                added.add(_anchor(gtsam, node))
                values.insert(node, start.atRot3(node))
            else:
                node_from_parent = start.atRot3(parent).between(start.atRot3(node))
                values.insert(node, isam.calculateEstimateRot3(parent).compose(node_from_parent))
            isam.update(added, values)
    return Answer(_body_from_world(isam.calculateEstimate(), graph.num_nodes), clock.seconds, clock.cpu_seconds)


def _source_from_target(gtsam: Any, graph: ViewGraph) -> list[Any]:
    """GTSAM's measurements: its values are world_from_body, so an edge is their difference the other way round."""
    return _rot3(gtsam, rotations.inverse(graph.target_from_source))


def _rot3(gtsam: Any, quaternion: Tensor) -> list[Any]:
    return [gtsam.Rot3.Quaternion(w, x, y, z) for x, y, z, w in quaternion.tolist()]


def _noise_models(gtsam: Any, graph: ViewGraph) -> list[Any]:
    return [gtsam.noiseModel.Isotropic.Sigma(3, value) for value in stated_sigma(graph).tolist()]


def _between_factors(gtsam: Any, graph: ViewGraph, loss_of_closures: Any = None) -> list[Any]:
    noise = _noise_models(gtsam, graph)
    if loss_of_closures is not None:
        noise = [
            model if is_odometry else gtsam.noiseModel.Robust.Create(loss_of_closures, model)
            for model, is_odometry in zip(noise, graph.is_odometry.tolist(), strict=True)
        ]
    edges = zip(graph.source.tolist(), graph.target.tolist(), _source_from_target(gtsam, graph), noise, strict=True)
    return [gtsam.BetweenFactorRot3(*edge) for edge in edges]


def _anchor(gtsam: Any, node: int) -> Any:
    return gtsam.PriorFactorRot3(node, gtsam.Rot3(), gtsam.noiseModel.Isotropic.Sigma(3, _ANCHOR_SIGMA))


def _start_values(gtsam: Any, graph: ViewGraph) -> Any:
    """Orientations along the odometry; roots are at the identity, where they are anchored."""
    values = gtsam.Values()
    orientations = rotations.inverse(start_orientations(graph)[0])
    for node, orientation in enumerate(_rot3(gtsam, orientations)):
        values.insert(node, orientation)
    return values


def _body_from_world(values: Any, num_nodes: int) -> Tensor:
    world_from_body = [values.atRot3(node).toQuaternion() for node in range(num_nodes)]
    return rotations.inverse(from_rows([[q.x(), q.y(), q.z(), q.w()] for q in world_from_body]))
