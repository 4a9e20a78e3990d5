"""CleanNet and FineNet as in the paper's text (NeuRoRA §4), beside those that this package develops.

Layers see an edge's features and the states of its ends, but no activation of the previous layer; edge features are
only quaternions. Solves and training are otherwise the package's own, so that differences are those of the method.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork, Wiring
from rotavg_ros.solver.neurora.network_store import StoredNetwork
from rotavg_ros.solver.neurora.tiled.passes import node_states
from rotavg_ros.solver.running.threads import for_each, slices

_FORGETFUL = Wiring(remembers=False)


class PaperCleanNet(CleanNet):
    """The paper's §4.1: x_uv = R̃_uv, initially empty node states, heads on the last layer's messages.

    Both directions of an edge are averaged, so that the direction in which it is given does not matter; the paper does
    not mention this.
    """

    NAME = "paper-clean-net"

    def __init__(self) -> None:
        super().__init__()
        self.network = MessagePassingNetwork(node_width=0, edge_width=4, wiring=_FORGETFUL)


class PaperFineNet(StoredNetwork):
    """The paper's §4.3: h_v⁰ = R_v, x_uv = e_uv, and one linear head on the last node state h_v.

        R_v ← R_v · normalise(1 + H h_v + b),        e_uv = R_v⁻¹ R̂_uv R_u

    All are quaternions, and R̂_uv is the measurement as corrected by CleanNet.
    """

    NAME = "paper-fine-net"

    def __init__(self) -> None:
        super().__init__()
        self.network = MessagePassingNetwork(node_width=4, edge_width=4, wiring=_FORGETFUL)
        self.correction_head = nn.Linear(HIDDEN_WIDTH, 4)
        # Initially there is no correction.
        nn.init.zeros_(self.correction_head.weight)
        nn.init.zeros_(self.correction_head.bias)

    def forward(self, body_from_world: Tensor, residual: Tensor, edges: DirectedEdges) -> Tensor:
        """Corrected orientations ``(N, 4)``.

        Args:
            body_from_world: ``(N, 4)`` current estimate R_v.
            residual: ``(M, 4)`` e_uv of the edges as given, w ≥ 0.
        """
        both = torch.cat((residual, rotations.inverse(residual)))
        states, _ = self.network(body_from_world, both, edges)
        return self.correct(body_from_world, states)

    def correct(self, body_from_world: Tensor, states: Tensor) -> Tensor:
        """Orientations ``(N, 4)``, corrected by the last node states ``(N, hidden)``."""
        change = self.correction_head(states)
        unit = rotations.identity(1, dtype=change.dtype, device=change.device)
        correction = nn.functional.normalize(unit + change, dim=1)
        return rotations.canonical(rotations.multiply(body_from_world, correction))


@torch.no_grad()
def paper_fine_tune(network: PaperFineNet, cleaned: Cleaned, body_from_world: Tensor) -> Tensor:
    """The paper's FineNet over the inlier edges, ``(N, 4)`` float64 on the graph's device."""
    device = next(network.parameters()).device
    start = rotations.canonical(body_from_world).float().to(device)
    rectified = cleaned.graph.to(device)
    residuals = EdgeResiduals(rectified, start)
    features = start.new_empty(rectified.num_edges, 4)

    def write(part: slice) -> None:
        features[part] = residuals.quaternions(part).t()

    for_each(write, slices(rectified.num_edges, SLICE_EDGES, device))
    edges = cleaned.edges.select(cleaned.is_inlier).to(device)
    states = node_states(network.network, start, features, edges)
    return network.correct(start, states).double().to(cleaned.graph.device)
