"""The probability that an edge is an outlier, from its residual."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.algebra.residuals import EdgeResiduals
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


def residual_score(
    graph: ViewGraph, body_from_world: Tensor, outlier_angle: float, component: Tensor | None = None
) -> Tensor:
    """Probability ``(M,)`` float64 that an edge's noise exceeds ``outlier_angle`` (radians), from its residual.

    The residual differs from the noise by the error of the orientations at the edge's ends. The probability is one half
    at the outlier angle; the better the ends are known, the closer it is to certainty on either side. Edges that the
    user has rejected score 1 and say nothing of others.
    """
    is_allowed = graph.label != EdgeLabel.REJECTED
    if bool(is_allowed.all()):
        return residual_probability(*residual_and_uncertainty(graph, body_from_world, component), outlier_angle)
    score = torch.ones(graph.num_edges, dtype=torch.float64, device=graph.device)
    allowed = graph.select_edges(is_allowed)
    if allowed.num_edges:
        score[is_allowed] = residual_score(allowed, body_from_world, outlier_angle, component)
    return score


def residual_probability(angle: Tensor, uncertainty: Tensor, outlier_angle: float) -> Tensor:
    """The same, from residuals and uncertainties ``(M,)`` of :func:`residual_and_uncertainty`."""
    return torch.sigmoid((angle - outlier_angle) / (NUMBERS.score_scale * uncertainty)).double()


def residual_and_uncertainty(
    graph: ViewGraph, body_from_world: Tensor, component: Tensor | None = None, angle: Tensor | None = None
) -> tuple[Tensor, Tensor]:
    """Residual angle of every edge and, up to a constant, the error of the orientations at its ends.

    A node's error is inversely proportional to the root of its number of edges d: median residual
    · √(1/d_source + 1/d_target).

    Args:
        component: ``(N,)`` the median is taken for each component separately; default: for all edges.
        angle: ``(M,)`` rad, the residuals; default: computed.

    Returns:
        Both ``(M,)`` float32 radians.
    """
    angle = EdgeResiduals(graph, body_from_world.float()).angles() if angle is None else angle
    degree = torch.bincount(graph.source, minlength=graph.num_nodes)
    share = 1 / degree.add_(torch.bincount(graph.target, minlength=graph.num_nodes)).float()
    spread = share.index_select(0, graph.source).add_(share.index_select(0, graph.target)).sqrt_()
    median = angle.median()
    if component is not None and bool((component > 0).any()):
        of_edge = component[graph.source]
        median = median_by_group(angle, of_edge, int(component.max()) + 1)[of_edge]
    return angle, (median * spread).clamp_(min=NUMBERS.min_uncertainty)
