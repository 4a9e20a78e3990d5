"""CleanNet (NeuRoRA §4.1): corrects the noise of every measured relative rotation and scores it as an outlier."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork


@dataclass(frozen=True)
class CleanEdges:
    """What CleanNet says of M edges.

    Attributes:
        target_from_source: ``(M, 4)`` the measurement with its predicted noise taken off.
        outlier_logit: ``(M,)`` log-odds of being an outlier.
    """

    target_from_source: Tensor
    outlier_logit: Tensor


class CleanNet(nn.Module):
    """Local consistency of every edge with its neighbourhood of four hops.

    Args:
        extra_edge_features: width of what is known of an edge besides its rotation (0 in the paper; the SLAM family
            adds kind, scale and discrepancy). They must not depend on the edge's direction.
    """

    def __init__(self, extra_edge_features: int = 0) -> None:
        super().__init__()
        self.extra_edge_features = extra_edge_features
        self.network = MessagePassingNetwork(node_width=0, edge_width=4 + extra_edge_features)
        self.noise_head = nn.Linear(HIDDEN_WIDTH, 4)
        self.outlier_head = nn.Linear(HIDDEN_WIDTH, 1)

    def forward(
        self, target_from_source: Tensor, edges: DirectedEdges, extra_features: Tensor | None = None
    ) -> CleanEdges:
        """``target_from_source`` ``(M, 4)``, ``extra_features`` ``(M, extra_edge_features)``."""
        num_edges = len(target_from_source)
        features = torch.cat((target_from_source, rotations.inverse(target_from_source)))
        if extra_features is not None:
            features = torch.cat((features, extra_features.repeat(2, 1)), dim=1)
        no_states = features.new_zeros(edges.num_nodes, 0)
        _, messages = self.network(no_states, features, edges)
        noise, logit = self.noise_head(messages), self.outlier_head(messages).squeeze(1)
        return CleanEdges(
            correct(target_from_source, noise[:num_edges], noise[num_edges:]),
            (logit[:num_edges] + logit[num_edges:]) / 2,
        )


def correct(target_from_source: Tensor, forward: Tensor, backward: Tensor) -> Tensor:
    """Measurements ``(M, 4)`` without the noise that the messages of their two directions predict, ``(M, 4)`` each."""
    # R̃_uv = clean · noise holds for the edge as given; the reversed edge's noise is seen from the other end,
    # so it is carried over by the measurement before the two opinions are averaged.
    carried = rotations.multiply(
        rotations.multiply(rotations.inverse(target_from_source), rotations.inverse(backward)), target_from_source
    )
    unit = rotations.identity(1, dtype=forward.dtype, device=forward.device)
    noise = nn.functional.normalize(unit + (forward + carried) / 2, dim=1)
    return rotations.canonical(rotations.multiply(target_from_source, noise))
