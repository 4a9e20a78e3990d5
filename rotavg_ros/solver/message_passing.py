"""The message-passing network under CleanNet and FineNet (NeuRoRA §4, eqs. 4–6).

A layer computes, for every directed edge u→v with features ``x_uv`` and for every node v with state ``h_v``,

    m_uv = ψ(h_v, h_u, x_uv)                      ψ: linear, ReLU, linear
    h_v ← ReLU(γ(h_v, mean over u of m_uv))       γ: linear, ReLU, linear

Every undirected edge is present in both directions. ψ's first linear map is a sum of three, so node states are
projected before they are gathered; its second one commutes with the mean, so it is applied to nodes, not to edges.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor, nn

HIDDEN_WIDTH = 32
NUM_LAYERS = 4


@dataclass(frozen=True)
class DirectedEdges:
    """Both directions of M edges: rows 0 … M-1 are the edges as given, rows M … 2M-1 the same edges reversed.

    Attributes:
        source, target: ``(2M,)`` node indices; a message runs source → target and is collected at the target.
        inverse_degree: ``(N, 1)``, 1/number of incoming messages (0 at isolated nodes).
    """

    source: Tensor
    target: Tensor
    inverse_degree: Tensor

    @classmethod
    def of(cls, source: Tensor, target: Tensor, num_nodes: int, dtype: torch.dtype = torch.float32) -> DirectedEdges:
        both_sources = torch.cat((source, target))
        both_targets = torch.cat((target, source))
        degree = torch.bincount(both_targets, minlength=num_nodes)
        inverse_degree = torch.where(degree > 0, 1 / degree.clamp(min=1).to(dtype), 0.0)[:, None]
        return cls(both_sources, both_targets, inverse_degree)

    @property
    def num_nodes(self) -> int:
        return len(self.inverse_degree)


class MessagePassingLayer(nn.Module):
    """One round of messages.

    Args:
        node_width: width of the incoming node states; 0 where they are still empty.
        edge_width: width of the edge features.
        hidden_width: width of messages and outgoing node states.
    """

    def __init__(self, node_width: int, edge_width: int, hidden_width: int = HIDDEN_WIDTH) -> None:
        super().__init__()
        self.node_width = node_width
        self.edge_projection = nn.Linear(edge_width, hidden_width)
        if node_width:
            self.target_projection = nn.Linear(node_width, hidden_width, bias=False)
            self.source_projection = nn.Linear(node_width, hidden_width, bias=False)
        self.message_output = nn.Linear(hidden_width, hidden_width)
        self.update = nn.Sequential(
            nn.Linear(node_width + hidden_width, hidden_width), nn.ReLU(), nn.Linear(hidden_width, hidden_width)
        )

    def activate(self, nodes: Tensor, features: Tensor, edges: DirectedEdges) -> Tensor:
        """ψ without its last linear map, ``(2M, hidden)``."""
        activation = self.edge_projection(features)
        if self.node_width:
            activation = activation + self.target_projection(nodes).index_select(0, edges.target)
            activation = activation + self.source_projection(nodes).index_select(0, edges.source)
        return torch.relu(activation)

    def forward(self, nodes: Tensor, features: Tensor, edges: DirectedEdges) -> tuple[Tensor, Tensor]:
        """Node states ``(N, node_width)``, edge features ``(2M, edge_width)`` → states ``(N, hidden)``, activations."""
        activation = self.activate(nodes, features, edges)
        collected = activation.new_zeros(edges.num_nodes, activation.shape[1])
        collected = collected.index_add(0, edges.target, activation) * edges.inverse_degree
        connected = (edges.inverse_degree > 0).to(collected)
        message = self.message_output(collected) * connected
        return torch.relu(self.update(torch.cat((nodes, message), dim=1))), activation


class MessagePassingNetwork(nn.Module):
    """A stack of :class:`MessagePassingLayer`; heads are the business of the networks built on it.

    Args:
        node_width: width of the initial node states, 0 for none.
        edge_width: width of the edge features, the same for all layers.
    """

    def __init__(
        self, node_width: int, edge_width: int, hidden_width: int = HIDDEN_WIDTH, num_layers: int = NUM_LAYERS
    ) -> None:
        super().__init__()
        widths = [node_width] + [hidden_width] * (num_layers - 1)
        self.layers = nn.ModuleList(MessagePassingLayer(width, edge_width, hidden_width) for width in widths)

    def forward(self, nodes: Tensor, features: Tensor, edges: DirectedEdges) -> tuple[Tensor, Tensor]:
        """Returns the last node states ``(N, hidden)`` and the last layer's messages ``(2M, hidden)``."""
        activation = features
        for layer in self.layers:
            nodes, activation = layer(nodes, features, edges)
        return nodes, self.layers[-1].message_output(activation)
