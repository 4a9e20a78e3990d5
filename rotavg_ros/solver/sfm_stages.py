"""The paper's stages on an SfM view-graph, as the pipeline runs them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.clean_net import CleanNet
from rotavg_ros.solver.fine_net import FineNet
from rotavg_ros.solver.relaxed_forest import hubs, relaxed_forest
from rotavg_ros.solver.residuals import EdgeResiduals
from rotavg_ros.solver.sfm_inference import clean_edges, fine_tuned, median_by_group
from rotavg_ros.solver.sorted_edges import SortedEdges
from rotavg_ros.solver.spanning_tree import compose, shortest_path_forest
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
# Divided by the edges of that end which has fewer: CleanNet rectifies well where an edge has company.
_FRINGE_COST = 5.0
# So many edges tell which of two trees fits better.
_MISFIT_SAMPLE = 16_384


@dataclass(frozen=True)
class Cleaned:
    """A view-graph after CleanNet.

    Attributes:
        graph: the rectified measurements.
        measured: the graph as it was given.
        outlier_probability: ``(M,)`` float32.
        is_inlier: ``(M,)`` bool.
        edges: all of the graph's edges, sorted.
    """

    graph: ViewGraph
    measured: ViewGraph
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
    return Cleaned(rectified, graph, probability, probability < OUTLIER_THRESHOLD, edges)


def trust_all(graph: ViewGraph) -> Cleaned:
    """What stands in for CleanNet in methods without it: every measurement as it is."""
    nobody = torch.zeros(graph.num_edges, device=graph.device)
    return Cleaned(graph, graph, nobody, nobody < OUTLIER_THRESHOLD, SortedEdges.of(graph))


def apply_labels(cleaned: Cleaned, label: Tensor) -> Cleaned:
    """Verdicts from outside override the network's."""
    probability = torch.where(label == EdgeLabel.ACCEPTED, 0.0, cleaned.outlier_probability)
    probability = torch.where(label == EdgeLabel.REJECTED, 1.0, probability)
    return replace(cleaned, outlier_probability=probability, is_inlier=probability < OUTLIER_THRESHOLD)


class Bootstrapped(NamedTuple):
    """Where FineNet begins.

    Attributes:
        body_from_world: ``(N, 4)`` float64.
        roots: ``(C,)`` the trees' roots, in the order of the components.
        cleaned: without CleanNet's corrections where the measurements as they are were better.
    """

    body_from_world: Tensor
    roots: Tensor
    cleaned: Cleaned


def bootstrap(cleaned: Cleaned, component: Tensor | None = None) -> Bootstrapped:
    """Orientations along a shortest-path tree that avoids outliers.

    A tree is composed of rectified measurements or of those as they are, whichever fits the latter better: where noise
    is far below what CleanNet was trained on, rectifying does harm.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    degree = cleaned.edges.degree
    fewest = torch.minimum(degree[cleaned.graph.source], degree[cleaned.graph.target])
    cost = _EDGE_COST + _OUTLIER_COST * cleaned.outlier_probability + _FRINGE_COST / fewest
    if cleaned.graph.device.type == "cpu":
        forest = shortest_path_forest(cleaned.graph, cost, edges=cleaned.edges, component=component)
        parent, parent_edge = torch.from_numpy(forest.parent), torch.from_numpy(forest.parent_edge)
        roots = torch.from_numpy(forest.roots)
    else:
        tree = relaxed_forest(cleaned.edges, cost, hubs(cleaned.edges, component))
        parent, parent_edge, roots = tree.parent, tree.parent_edge, tree.roots
    rectified, raw = (compose(parent, parent_edge, graph) for graph in (cleaned.graph, cleaned.measured))
    rectified_misfit, raw_misfit = _misfits(cleaned, (rectified, raw), component)
    raw_is_better = raw_misfit <= rectified_misfit
    if not bool(raw_is_better.any()):
        return Bootstrapped(rectified, roots, cleaned)
    chosen = raw_is_better[component][:, None]
    relative = torch.where(
        chosen[cleaned.graph.source], cleaned.measured.target_from_source, cleaned.graph.target_from_source
    )
    cleaned = replace(cleaned, graph=replace(cleaned.graph, target_from_source=relative))
    return Bootstrapped(torch.where(chosen, raw, rectified), roots, cleaned)


def _misfits(cleaned: Cleaned, candidates: Sequence[Tensor], component: Tensor) -> list[Tensor]:
    """Median angle between the inliers as measured and as each of ``candidates`` has them, per component."""
    sample = cleaned.is_inlier.nonzero().squeeze(1)
    sample = sample[:: 1 + len(sample) // _MISFIT_SAMPLE]
    edges = cleaned.measured.select_edges(sample)
    angles = [EdgeResiduals(edges, body_from_world.float()).angles() for body_from_world in candidates]
    count = int(component.max()) + 1
    return [median_by_group(angle, component[edges.source], count) for angle in angles]


@torch.no_grad()
def fine_tune(network: FineNet, cleaned: Cleaned, body_from_world: Tensor, component: Tensor | None = None) -> Tensor:
    """FineNet over the inlier edges, without gradients, ``(N, 4)`` float64.

    The network may be on another device than the graph; what comes back is on the graph's.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    device = next(network.parameters()).device
    fine = fine_tuned(
        network,
        cleaned.measured.to(device),
        cleaned.graph.target_from_source.to(device),
        cleaned.outlier_probability.logit().to(device),
        body_from_world.float().to(device),
        cleaned.edges.select(cleaned.is_inlier).to(device),
        component.to(device),
    )
    return fine.double().to(cleaned.graph.device)


def outlier_score(
    graph: ViewGraph, cleaned: Cleaned, body_from_world: Tensor, component: Tensor, by_residuals: bool
) -> Tensor:
    """Probability that an edge's noise exceeds 20°, ``(M,)`` float64.

    CleanNet's own where there is but a tree; after FineNet or refinement that of the residual, which is the noise but
    for the orientations' error.
    """
    if not by_residuals:
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
    return torch.sigmoid((angle - outlier_angle) / (SCORE_SCALE * uncertainty)).double()


def residual_and_uncertainty(
    graph: ViewGraph, body_from_world: Tensor, component: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Residual angle of every edge and, up to a constant, the error of the orientations at its ends.

    A node's error falls with the root of its number of edges d: median residual · √(1/d_source + 1/d_target), the
    median of each ``component`` ``(N,)`` for itself; default: of all edges.

    Returns:
        Both ``(M,)`` float32 radians.
    """
    angle = EdgeResiduals(graph, body_from_world.float()).angles()
    share = 1 / torch.bincount(torch.cat((graph.source, graph.target)), minlength=graph.num_nodes).float()
    spread = share.index_select(0, graph.source).add_(share.index_select(0, graph.target)).sqrt_()
    median = angle.median()
    if component is not None and bool((component > 0).any()):
        of_edge = component[graph.source]
        median = median_by_group(angle, of_edge, int(component.max()) + 1)[of_edge]
    return angle, (median * spread).clamp_(min=_MIN_UNCERTAINTY)
