"""FineNet (NeuRoRA §4.3): corrects absolute orientations from the residuals of the edges around them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork


class FineNet(nn.Module):
    """One correction of all orientations.

    Args:
        extra_edge_features: width of what is known of an edge besides its residual, direction-free.
    """

    def __init__(self, extra_edge_features: int = 0) -> None:
        super().__init__()
        self.extra_edge_features = extra_edge_features
        self.network = MessagePassingNetwork(node_width=4, edge_width=4 + extra_edge_features)
        self.correction_head = nn.Linear(HIDDEN_WIDTH, 4)

    def forward(
        self, body_from_world: Tensor, residual: Tensor, edges: DirectedEdges, extra_features: Tensor | None = None
    ) -> Tensor:
        """Corrected orientations ``(N, 4)``.

        Args:
            body_from_world: ``(N, 4)`` current estimate R̃_v.
            residual: ``(M, 4)`` world rotations ``R̃_v⁻¹ R̃_uv R̃_u`` of the edges.
        """
        residual = rotations.canonical(residual)
        features = torch.cat((residual, rotations.inverse(residual)))
        if extra_features is not None:
            features = torch.cat((features, extra_features.repeat(2, 1)), dim=1)
        states, _ = self.network(body_from_world, features, edges)
        return self.correct(body_from_world, states)

    def correct(self, body_from_world: Tensor, states: Tensor) -> Tensor:
        """Orientations ``(N, 4)`` corrected by what the last node states ``(N, hidden)`` say."""
        unit = rotations.identity(1, dtype=states.dtype, device=states.device)
        # Residuals are rotations of the world frame, and so is the correction: it goes on the right.
        correction = nn.functional.normalize(unit + self.correction_head(states), dim=1)
        return rotations.canonical(rotations.multiply(body_from_world, correction))


def edge_residual(body_from_world: Tensor, target_from_source: Tensor, source: Tensor, target: Tensor) -> Tensor:
    """``e_uv = R_v⁻¹ R̃_uv R_u``, ``(M, 4)``: the world rotation by which edge u→v disagrees with the orientations."""
    predicted_source = rotations.multiply(target_from_source, body_from_world.index_select(0, source))
    return rotations.multiply(rotations.inverse(body_from_world.index_select(0, target)), predicted_source)
