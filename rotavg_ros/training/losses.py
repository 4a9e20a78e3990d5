"""The paper's losses (NeuRoRA §4, eqs. 9–10)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.neurora.message_passing import DirectedEdges

OUTLIER_LOSS_WEIGHT = 10.0
NODE_LOSS_WEIGHT = 1.0
PAPER_NODE_LOSS_WEIGHT = 0.1
_SMALL = 1e-8
_WEISZFELD_STEPS, _WEISZFELD_SMOOTHING = 4, 0.01


def quaternion_distance(a: Tensor, b: Tensor) -> Tensor:
    """Chordal distance min(‖a − b‖, ‖a + b‖) of unit quaternions ``(..., 4)``; about half the angle in radians."""
    square = torch.minimum(((a - b) ** 2).sum(-1), ((a + b) ** 2).sum(-1))
    # The gradient of the root is infinite at zero.
    return (square + _SMALL).sqrt()


def degree_normalised(edge_values: Tensor, edges: DirectedEdges) -> Tensor:
    """Mean over nodes of the mean over their edges of ``edge_values`` ``(M,)``: no hub outweighs the rest."""
    both = edge_values.repeat(2) * edges.inverse_degree.squeeze(1)[edges.target]
    connected = (edges.inverse_degree > 0).sum().clamp(min=1)
    return both.sum() / connected


def clean_net_loss(
    clean: Tensor, outlier_logit: Tensor, true_relative: Tensor, is_outlier: Tensor, edges: DirectedEdges
) -> dict[str, Tensor]:
    """Rotation and outlier terms and their weighted sum ``loss``.

    Args:
        clean, true_relative: ``(M, 4)`` predicted and true target_from_source.
        outlier_logit: ``(M,)``; is_outlier: ``(M,)`` bool.
    """
    rotation = degree_normalised(quaternion_distance(clean, true_relative), edges)
    outlier = nn.functional.binary_cross_entropy_with_logits(outlier_logit, is_outlier.to(outlier_logit))
    return {"loss": rotation + OUTLIER_LOSS_WEIGHT * outlier, "rotation": rotation, "outlier": outlier}


def fine_net_loss(
    body_from_world: Tensor, truth: Tensor, scale: Tensor, graph: Tensor, edges: DirectedEdges
) -> dict[str, Tensor]:
    """Edge term (errors of relative orientations) plus node term, either in units of the graph's noise.

    The error ε_v of a node is twice x, y, z of the quaternion R_v,true⁻¹ R_v: along its axis, of length 2 sin(θ/2) for
    an error of θ, which is the rotation vector to within 1 % up to 28°.

    The node term is relative to a robust mean of each graph's errors, so that no gauge is learned. It is the reported
    error, and weighs as much as the edge term (a tenth of it in the paper, where the gauge is the tree's).

    Args:
        body_from_world, truth: ``(N, 4)``, in about the same gauge.
        scale: ``(N, 1)`` typical residual of the node's graph (half an angle in radians).
        graph: ``(N,)`` index of every node's graph.
    """
    difference = rotations.canonical(rotations.multiply(rotations.inverse(truth), body_from_world))
    error = 2 * difference[:, :3]
    error = error - _robust_means(error.detach(), graph)[graph]
    size = _length(error)
    half = len(edges.source) // 2
    apart = _length(error[edges.target[:half]] - error[edges.source[:half]])
    unit = 2 * scale.squeeze(1)
    edge = degree_normalised(apart / unit[edges.target[:half]], edges)
    node = (size / unit).mean()
    return {"loss": edge + NODE_LOSS_WEIGHT * node, "edge": edge, "node": node}


def paper_fine_net_loss(body_from_world: Tensor, truth: Tensor, edges: DirectedEdges) -> dict[str, Tensor]:
    """The paper's equation 10 as in its text: edge term + 0.1 · node term, both of quaternion distances.

    Args:
        body_from_world, truth: ``(N, 4)``, in the same gauge: that of the tree's root.
    """
    half = len(edges.source) // 2
    source, target = edges.source[:half], edges.target[:half]
    relative, true_relative = (
        rotations.multiply(of_nodes[target], rotations.inverse(of_nodes[source]))
        for of_nodes in (body_from_world, truth)
    )
    edge = degree_normalised(quaternion_distance(relative, true_relative), edges)
    node = quaternion_distance(body_from_world, truth).mean()
    return {"loss": edge + PAPER_NODE_LOSS_WEIGHT * node, "edge": edge, "node": node}


def _robust_means(vectors: Tensor, group: Tensor) -> Tensor:
    """Geometric medians of the vectors ``(N, 3)`` of each group, ``(groups, 3)``, by a few steps of Weiszfeld's."""
    num_groups = int(group.max()) + 1
    mean = vectors.new_zeros(num_groups, 3)
    for _ in range(_WEISZFELD_STEPS):
        weight = 1 / (_length(vectors - mean[group])[:, None] + _WEISZFELD_SMOOTHING)
        total = weight.new_zeros(num_groups, 1).index_add(0, group, weight)
        mean = vectors.new_zeros(num_groups, 3).index_add(0, group, weight * vectors) / total
    return mean


def _length(vectors: Tensor) -> Tensor:
    # The gradient of the root is infinite at zero.
    return ((vectors**2).sum(-1) + _SMALL).sqrt()
