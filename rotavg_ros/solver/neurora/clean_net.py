"""CleanNet (NeuRoRA §4.1): corrects the noise of every measured relative rotation and scores it as an outlier."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.neurora.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork
from rotavg_ros.solver.neurora.network_store import StoredNetwork


@dataclass(frozen=True)
class CleanEdges:
    """CleanNet's result for M edges.

    Attributes:
        target_from_source: ``(M, 4)`` the measurements without their predicted noise.
        outlier_logit: ``(M,)`` log-odds of being an outlier.
    """

    target_from_source: Tensor
    outlier_logit: Tensor


class CleanNet(StoredNetwork):
    """Local consistency of every edge with its neighbourhood of four hops.

    The features of an edge are the measured quaternion R̃_uv; node states are initially empty. From the message m_uv of
    the last layer (``message_passing.py``), and m_vu of the reversed edge, two linear heads compute

        n_uv = ½ (H m_uv + h + R̃_uv⁻¹ (H m_vu + h)⁻¹ R̃_uv)      the noise, as a change of the identity quaternion,
        R̂_uv = R̃_uv · (1 + n_uv) / ‖1 + n_uv‖                    the measurement without the noise,
        logit = ½ (g·m_uv + g·m_vu) + g₀                          log-odds that the edge is an outlier.

    A solve runs the same formula in ``tiled/networks.py``: ``clean_edges``.
    """

    NAME = "sfm-clean-net"

    def __init__(self) -> None:
        super().__init__()
        self.network = MessagePassingNetwork(node_width=0, edge_width=4)
        self.noise_head = nn.Linear(HIDDEN_WIDTH, 4)
        self.outlier_head = nn.Linear(HIDDEN_WIDTH, 1)

    def forward(self, target_from_source: Tensor, edges: DirectedEdges) -> CleanEdges:
        """Measurements ``(M, 4)`` → corrected measurements and log-odds."""
        num_edges = len(target_from_source)
        features = torch.cat((target_from_source, rotations.inverse(target_from_source)))
        no_states = features.new_zeros(edges.num_nodes, 0)
        _, messages = self.network(no_states, features, edges)
        noise, logit = self.noise_head(messages), self.outlier_head(messages).squeeze(1)
        return CleanEdges(
            correct(target_from_source, noise[:num_edges], noise[num_edges:]),
            (logit[:num_edges] + logit[num_edges:]) / 2,
        )


def correct(target_from_source: Tensor, forward: Tensor, backward: Tensor) -> Tensor:
    """Measurements ``(M, 4)`` without the noise that the messages of their two directions predict, ``(M, 4)`` each."""
    # R̃_uv = clean · noise holds for the edge as given. The reversed edge's noise is in the frame of the other end, so
    # the measurement carries it over before the two predictions are averaged.
    carried = rotations.multiply(
        rotations.multiply(rotations.inverse(target_from_source), rotations.inverse(backward)), target_from_source
    )
    unit = rotations.identity(1, dtype=forward.dtype, device=forward.device)
    noise = nn.functional.normalize(unit + (forward + carried) / 2, dim=1)
    return rotations.canonical(rotations.multiply(target_from_source, noise))
