"""FineNet (NeuRoRA §4.3): corrects absolute orientations from the residuals of the edges around them."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.neurora.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork, Wiring
from rotavg_ros.solver.neurora.network_store import StoredNetwork
from rotavg_ros.solver.neurora.numbers import NUMBERS

# Features of an edge: three vectors, which change sign with its direction, and two numbers, which do not.
ODD_FEATURES, EVEN_FEATURES = 9, 2
# Features of a node: its orientation and its number of edges.
NODE_FEATURES = 5


class FineNet(StoredNetwork):
    """One correction of all orientations.

    A node's initial state is h_v = [R_v, log(1 + degree)/4], with the current estimate R_v. The features of an edge are
    those of :func:`edge_features`, computed from its residuals e_uv. From the last state (``message_passing.py``), one
    linear head gives the tangent of half the correction's angle, along its axis, in units of the scale s:

        t_v = s (H h_v + b),        R_v ← R_v · [t_v, 1] / ‖[t_v, 1]‖.

    A solve runs the same formula in ``tiled/networks.py``: ``fine_tuned``.

    Rectified measurements are precise, but their errors are alike throughout a neighbourhood. Raw errors are
    independent. Their mean over a region estimates the region's common error. FineNet sees the residuals of both. All
    angles are in units of s, the median raw residual, so that it is the same at any level of noise.
    """

    NAME = "sfm-fine-net"

    def __init__(self) -> None:
        super().__init__()
        self.network = MessagePassingNetwork(
            NODE_FEATURES, ODD_FEATURES + EVEN_FEATURES, odd_width=ODD_FEATURES, wiring=Wiring(accumulates=True)
        )
        self.correction_head = nn.Linear(HIDDEN_WIDTH, 3)
        # Initially there is no correction.
        nn.init.zeros_(self.correction_head.weight)
        nn.init.zeros_(self.correction_head.bias)

    def forward(self, body_from_world: Tensor, features: Tensor, scale: Tensor, edges: DirectedEdges) -> Tensor:
        """Corrected orientations ``(N, 4)``.

        Args:
            body_from_world: ``(N, 4)`` current estimate R_v.
            features: ``(M, ODD_FEATURES + EVEN_FEATURES)`` of the edges as given, from :func:`edge_features`.
            scale: s, ``(N, 1)`` or ``(1, 1)``, the unit of the features.
        """
        backward = torch.cat((-features[:, :ODD_FEATURES], features[:, ODD_FEATURES:]), dim=1)
        states = node_features(body_from_world, 1 / edges.inverse_degree)
        states, _ = self.network(states, torch.cat((features, backward)), edges)
        return self.correct(body_from_world, states, scale)

    def correct(self, body_from_world: Tensor, states: Tensor, scale: Tensor) -> Tensor:
        """Orientations ``(N, 4)``, corrected by the last node states ``(N, hidden)``."""
        # t_v, the tangent of half the angle, along the axis.
        tangent = self.correction_head(states) * scale
        correction = nn.functional.normalize(torch.cat((tangent, torch.ones_like(tangent[:, :1])), dim=1), dim=1)
        # Residuals are rotations of the world frame, and so is the correction: it goes on the right.
        return rotations.canonical(rotations.multiply(body_from_world, correction))


def edge_features(raw: Tensor, rectified: Tensor, outlier_logit: Tensor, scale: Tensor) -> Tensor:
    """FineNet's features of k edges, ``(ODD_FEATURES + EVEN_FEATURES, k)``.

    Args:
        raw, rectified: ``(3, k)`` x, y, z of the residual quaternions (w ≥ 0) of the measurements as they are and
            after CleanNet.
        outlier_logit: ``(k,)`` CleanNet's log-odds.
        scale: s, ``(k,)`` or a number, the median length of ``raw``.
    """
    raw, rectified = raw / scale, rectified / scale
    # The weight of an edge under a loss that is square for small residuals and linear for large ones.
    weight = (1 + (raw * raw).sum(dim=0, keepdim=True)).rsqrt()
    logit = outlier_logit.clamp(-NUMBERS.max_logit, NUMBERS.max_logit) / NUMBERS.logit_unit
    return torch.cat((raw, raw * weight, rectified, weight, logit[None]))


def node_features(body_from_world: Tensor, degree: Tensor) -> Tensor:
    """Features of nodes ``(N, NODE_FEATURES)``; ``degree`` ``(N, 1)`` may be infinite at nodes without edges."""
    known = torch.where(degree.isfinite(), degree, 0).to(body_from_world)
    return torch.cat((body_from_world, known.log1p() / NUMBERS.log_degree_unit), dim=1)
