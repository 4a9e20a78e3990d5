"""The paper's losses (NeuRoRA §4, eqs. 9–10)."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.message_passing import DirectedEdges

OUTLIER_LOSS_WEIGHT = 10.0
NODE_LOSS_WEIGHT = 0.1
_SMALL = 1e-8


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
    body_from_world: Tensor, truth: Tensor, source: Tensor, target: Tensor, edges: DirectedEdges
) -> dict[str, Tensor]:
    """Edge term (relative orientations, gauge-free) plus 0.1 × node term; ``truth`` in the estimate's gauge."""
    relative = rotations.multiply(body_from_world[target], rotations.inverse(body_from_world[source]))
    true_relative = rotations.multiply(truth[target], rotations.inverse(truth[source]))
    edge = degree_normalised(quaternion_distance(relative, true_relative), edges)
    node = quaternion_distance(body_from_world, truth).mean()
    return {"loss": edge + NODE_LOSS_WEIGHT * node, "edge": edge, "node": node}
