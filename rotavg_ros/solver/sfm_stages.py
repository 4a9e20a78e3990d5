"""The paper's stages on an SfM view-graph, as the pipeline runs them and as training sees them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.clean_net import CleanNet
from rotavg_ros.solver.fine_net import FineNet, edge_residual
from rotavg_ros.solver.message_passing import DirectedEdges
from rotavg_ros.solver.spanning_tree import SpanningForest, compose_orientations, shortest_path_forest
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# An edge whose outlier probability exceeds this is no inlier (ε of the paper; uncritical in 0.35–0.8).
OUTLIER_THRESHOLD = 0.75
# How fast the probability of noise beyond the outlier angle rises with the residual, in units of how far off the edge's
# ends may be; fitted by `python -m rotavg_ros.training.score_fit`.
SCORE_SCALE = 0.41
_MIN_UNCERTAINTY = np.radians(0.01)
# The noise that makes an edge an outlier.
OUTLIER_ANGLE = np.radians(20.0)
# Cost of an edge in the tree (the authors' released code).
_INLIER_COST, _OUTLIER_COST = 0.1, 1.1


@dataclass(frozen=True)
class Cleaned:
    """A view-graph after CleanNet.

    Attributes:
        graph: the rectified measurements.
        outlier_probability: ``(M,)`` float32.
        is_inlier: ``(M,)`` bool.
    """

    graph: ViewGraph
    outlier_probability: Tensor
    is_inlier: Tensor


def clean(network: CleanNet, graph: ViewGraph, edges: DirectedEdges | None = None) -> Cleaned:
    """CleanNet: rectify every measurement and score it. The network may be on another device than the graph."""
    device = next(network.parameters()).device
    if edges is None:
        edges = DirectedEdges.of(graph.source.to(device), graph.target.to(device), graph.num_nodes)
    result = network(graph.target_from_source.float().to(device), edges)
    probability = torch.sigmoid(result.outlier_logit).to(graph.device)
    rectified = replace(graph, target_from_source=result.target_from_source.double().to(graph.device))
    return Cleaned(rectified, probability, probability < OUTLIER_THRESHOLD)


def trust_all(graph: ViewGraph) -> Cleaned:
    """What stands in for CleanNet in methods without it: every measurement as it is."""
    return Cleaned(graph, torch.zeros(graph.num_edges), torch.ones(graph.num_edges, dtype=torch.bool))


def apply_labels(cleaned: Cleaned, label: Tensor) -> Cleaned:
    """Verdicts from outside override the network's."""
    probability = torch.where(label == EdgeLabel.ACCEPTED, 0.0, cleaned.outlier_probability)
    probability = torch.where(label == EdgeLabel.REJECTED, 1.0, probability)
    return replace(cleaned, outlier_probability=probability, is_inlier=probability < OUTLIER_THRESHOLD)


def bootstrap(cleaned: Cleaned) -> tuple[Tensor, SpanningForest]:
    """Orientations along a shortest-path tree that avoids outliers, ``(N, 4)`` float64."""
    cost = torch.where(cleaned.is_inlier, _INLIER_COST, _OUTLIER_COST)
    forest = shortest_path_forest(cleaned.graph, cost)
    return compose_orientations(forest, cleaned.graph), forest


def fine_tune(network: FineNet, cleaned: Cleaned, body_from_world: Tensor) -> Tensor:
    """FineNet over the inlier edges, ``(N, 4)`` float64. The network may be on another device than the graph."""
    device = next(network.parameters()).device
    inliers = cleaned.graph.select_edges(cleaned.is_inlier)
    edges = DirectedEdges.of(inliers.source.to(device), inliers.target.to(device), inliers.num_nodes)
    residual = edge_residual(body_from_world, inliers.target_from_source, inliers.source, inliers.target)
    fine: Tensor = network(body_from_world.float().to(device), residual.float().to(device), edges)
    return fine.double().to(cleaned.graph.device)


def outlier_score(graph: ViewGraph, cleaned: Cleaned, body_from_world: Tensor, refined: bool) -> Tensor:
    """Probability that an edge's noise exceeds 20°, ``(M,)`` float64.

    CleanNet's own without refinement; after it the residual, which is the noise but for the orientations' error.
    """
    if not refined:
        return cleaned.outlier_probability.double()
    return residual_score(graph, body_from_world, OUTLIER_ANGLE)


def residual_score(graph: ViewGraph, body_from_world: Tensor, outlier_angle: float) -> Tensor:
    """Probability that an edge's noise exceeds ``outlier_angle`` (radians) as its residual has it, ``(M,)`` float64.

    The residual is the noise but for the error of the orientations at the edge's ends: one half at the outlier angle,
    and the closer to certainty on either side, the better the ends are known.
    """
    angle, uncertainty = residual_and_uncertainty(graph, body_from_world)
    return torch.sigmoid((angle - outlier_angle) / (SCORE_SCALE * uncertainty))


def residual_and_uncertainty(graph: ViewGraph, body_from_world: Tensor) -> tuple[Tensor, Tensor]:
    """Residual angle of every edge and, up to a constant, the error of the orientations at its ends; ``(M,)`` rad.

    A node's error falls with the root of its number of edges d: median residual · √(1/d_source + 1/d_target).
    """
    residual = edge_residual(body_from_world, graph.target_from_source, graph.source, graph.target)
    angle = rotations.angle(residual).double()
    degree = torch.bincount(torch.cat((graph.source, graph.target)), minlength=graph.num_nodes).double()
    spread = (1 / degree[graph.source] + 1 / degree[graph.target]).sqrt()
    return angle, (angle.median() * spread).clamp(min=_MIN_UNCERTAINTY)
