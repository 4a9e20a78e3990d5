"""The paper's stages on an SfM view-graph, as the pipeline runs them and as training sees them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.clean_net import CleanNet
from rotavg_ros.solver.fine_net import FineNet, edge_residual
from rotavg_ros.solver.message_passing import DirectedEdges
from rotavg_ros.solver.relaxed_forest import hubs, relaxed_forest
from rotavg_ros.solver.residuals import EdgeResiduals
from rotavg_ros.solver.sfm_inference import clean_edges, fine_tuned
from rotavg_ros.solver.sorted_edges import SortedEdges
from rotavg_ros.solver.spanning_tree import compose, compose_orientations, shortest_path_forest
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# An edge whose outlier probability exceeds this is no inlier (ε of the paper; uncritical in 0.35–0.8).
OUTLIER_THRESHOLD = 0.75
# How fast the probability of noise beyond the outlier angle rises with the residual, in units of how far off the edge's
# ends may be; fitted by `python -m rotavg_ros.training.score_fit`.
SCORE_SCALE = 0.376
_MIN_UNCERTAINTY = np.radians(0.01)
# The noise that makes an edge an outlier.
OUTLIER_ANGLE = np.radians(20.0)
# Cost of an edge in the tree, and what a certain outlier costs besides (the authors' released code, between the two).
_EDGE_COST, _OUTLIER_COST = 0.1, 1.0


@dataclass(frozen=True)
class Cleaned:
    """A view-graph after CleanNet.

    Attributes:
        graph: the rectified measurements.
        outlier_probability: ``(M,)`` float32.
        is_inlier: ``(M,)`` bool.
        edges: all of the graph's edges, sorted.
    """

    graph: ViewGraph
    outlier_probability: Tensor
    is_inlier: Tensor
    edges: SortedEdges


def clean(network: CleanNet, graph: ViewGraph) -> Cleaned:
    """CleanNet, without gradients: rectify every measurement and score it.

    The network may be on another device than the graph; what comes back is on the graph's.
    """
    device = next(network.parameters()).device
    edges = SortedEdges.of(graph)
    with torch.no_grad():
        result = clean_edges(network, graph.target_from_source.float().to(device), edges.to(device))
        probability = torch.sigmoid(result.outlier_logit).to(graph.device)
    rectified = replace(graph, target_from_source=result.target_from_source.to(graph.device).double())
    return Cleaned(rectified, probability, probability < OUTLIER_THRESHOLD, edges)


def trust_all(graph: ViewGraph) -> Cleaned:
    """What stands in for CleanNet in methods without it: every measurement as it is."""
    nobody = torch.zeros(graph.num_edges, device=graph.device)
    return Cleaned(graph, nobody, nobody < OUTLIER_THRESHOLD, SortedEdges.of(graph))


def apply_labels(cleaned: Cleaned, label: Tensor) -> Cleaned:
    """Verdicts from outside override the network's."""
    probability = torch.where(label == EdgeLabel.ACCEPTED, 0.0, cleaned.outlier_probability)
    probability = torch.where(label == EdgeLabel.REJECTED, 1.0, probability)
    return replace(cleaned, outlier_probability=probability, is_inlier=probability < OUTLIER_THRESHOLD)


def bootstrap(cleaned: Cleaned, component: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Orientations along a shortest-path tree that avoids outliers, ``(N, 4)`` float64, and the trees' roots ``(C,)``.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    cost = _EDGE_COST + _OUTLIER_COST * cleaned.outlier_probability
    if cleaned.graph.device.type == "cpu":
        forest = shortest_path_forest(cleaned.graph, cost, edges=cleaned.edges, component=component)
        return compose_orientations(forest, cleaned.graph), torch.from_numpy(forest.roots)
    tree = relaxed_forest(cleaned.edges, cost, hubs(cleaned.edges, component))
    return compose(tree.parent, tree.parent_edge, cleaned.graph), tree.roots


def fine_tune(network: FineNet, cleaned: Cleaned, body_from_world: Tensor) -> Tensor:
    """FineNet over the inlier edges, ``(N, 4)`` float64, with gradients where they are enabled.

    The network may be on another device than the graph; what comes back is on the graph's.
    """
    device = next(network.parameters()).device
    if torch.is_grad_enabled():
        inliers = cleaned.graph.select_edges(cleaned.is_inlier)
        directed = DirectedEdges.of(inliers.source.to(device), inliers.target.to(device), inliers.num_nodes)
        residual = edge_residual(body_from_world, inliers.target_from_source, inliers.source, inliers.target)
        fine: Tensor = network(body_from_world.float().to(device), residual.float().to(device), directed)
    else:
        edges = cleaned.edges.select(cleaned.is_inlier).to(device)
        fine = fine_tuned(network, cleaned.graph.to(device), body_from_world.float().to(device), edges)
    return fine.double().to(cleaned.graph.device)


def outlier_score(
    graph: ViewGraph, cleaned: Cleaned, body_from_world: Tensor, component: Tensor, refined: bool
) -> Tensor:
    """Probability that an edge's noise exceeds 20°, ``(M,)`` float64.

    CleanNet's own without refinement; after it the residual, which is the noise but for the orientations' error.
    """
    if not refined:
        return cleaned.outlier_probability.double()
    return residual_score(graph, body_from_world, OUTLIER_ANGLE, component)


def residual_score(
    graph: ViewGraph, body_from_world: Tensor, outlier_angle: float, component: Tensor | None = None
) -> Tensor:
    """Probability that an edge's noise exceeds ``outlier_angle`` (radians) as its residual has it, ``(M,)`` float64.

    The residual is the noise but for the error of the orientations at the edge's ends: one half at the outlier angle,
    and the closer to certainty on either side, the better the ends are known.
    """
    angle, uncertainty = residual_and_uncertainty(graph, body_from_world, component)
    return torch.sigmoid((angle - outlier_angle) / (SCORE_SCALE * uncertainty))


def residual_and_uncertainty(
    graph: ViewGraph, body_from_world: Tensor, component: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Residual angle of every edge and, up to a constant, the error of the orientations at its ends; ``(M,)`` rad.

    A node's error falls with the root of its number of edges d: median residual · √(1/d_source + 1/d_target), the
    median of each ``component`` ``(N,)`` for itself; default: of all edges.
    """
    angle = EdgeResiduals(graph, body_from_world).angles()
    degree = torch.bincount(torch.cat((graph.source, graph.target)), minlength=graph.num_nodes).double()
    spread = (1 / degree[graph.source] + 1 / degree[graph.target]).sqrt()
    median = angle.median()
    if component is not None and bool((component > 0).any()):
        of_edge = component[graph.source]
        median = _median_by_group(angle, of_edge, int(component.max()) + 1)[of_edge]
    return angle, (median * spread).clamp(min=_MIN_UNCERTAINTY)


def _median_by_group(value: Tensor, group: Tensor, num_groups: int) -> Tensor:
    """Lower median (torch's) ``(num_groups,)`` of the values ``(M,)`` of each group; infinite where there are none."""
    by_value = value.sort()
    by_group = group[by_value.indices].sort(stable=True).indices
    count = torch.bincount(group, minlength=num_groups)
    middle = count.cumsum(0) - count + (count - 1).clamp(min=0) // 2
    ordered = torch.cat((by_value.values[by_group], value.new_full((1,), torch.inf)))
    return torch.where(count > 0, ordered[middle], torch.inf)
