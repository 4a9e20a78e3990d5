"""FineNet of the SLAM profile: predicts the variance of each edge's noise, relative to the estimated one.

The paper's FineNet corrects orientations. On a robot's graph a sparse solve does that exactly once the variance of each
edge is known, so the variance is learned instead. Messages run from edges to their key nodes and back, so neighbouring
segments, and closures at the same places, exchange information:

    m_n ← mean over the segments at n of relu(h), mean over the closures at n of relu(h)
    h_e ← h_e + φ(h_e, m_source + m_target)

A linear layer on the last h_e and the features gives log (variance here / estimated variance), minus its mean over the
good edges of the same kind. Summing over both ends makes it independent of an edge's direction.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from rotavg_ros.solver.neurora.network_store import StoredNetwork
from rotavg_ros.solver.slam.fine_net.features import NUM_FEATURES, FineFeatures

_WIDTH, _ROUNDS = 32, 3
# Bound of the absolute log ratio.
_LARGEST = 5.0


class SlamFineNet(StoredNetwork):
    """Predicts the log ratio of every edge's variance to its estimate."""

    NAME = "slam-fine-net"

    def __init__(self) -> None:
        super().__init__()
        self.segment_encoder = nn.Sequential(nn.Linear(NUM_FEATURES, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH))
        self.closure_encoder = nn.Sequential(nn.Linear(NUM_FEATURES, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH))
        self.updates = nn.ModuleList(
            nn.Sequential(nn.Linear(3 * _WIDTH, _WIDTH), nn.ReLU(), nn.Linear(_WIDTH, _WIDTH)) for _ in range(_ROUNDS)
        )
        self.segment_head, self.closure_head = (nn.Linear(_WIDTH + NUM_FEATURES, 1) for _ in range(2))
        for head in (self.segment_head, self.closure_head):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, features: FineFeatures) -> Tensor:
        """``(E,)`` log ratios, of mean zero over the good edges of each graph and kind; 0 for all other edges."""
        odometry = torch.nonzero(features.is_odometry).squeeze(1)
        closure = torch.nonzero(~features.is_odometry).squeeze(1)
        x = features.edges
        state = x.new_zeros(len(x), _WIDTH)
        state = state.index_copy(0, odometry, self.segment_encoder(x[odometry]))
        state = state.index_copy(0, closure, self.closure_encoder(x[closure]))
        # Two slots per node: one for its segments, one for its closures.
        place = (2 * features.ends + ~features.is_odometry).reshape(-1)
        degree = torch.bincount(place, minlength=2 * features.num_nodes)
        inverse_degree = (1 / degree.clamp(min=1).to(x))[:, None]
        for update in self.updates:
            told = torch.relu(state).repeat(2, 1)
            heard = x.new_zeros(len(degree), _WIDTH).index_add(0, place, told) * inverse_degree
            at_nodes = heard.reshape(features.num_nodes, 2 * _WIDTH)
            around = at_nodes[features.ends[0]] + at_nodes[features.ends[1]]
            state = state + update(torch.cat((state, around), dim=1))
        both = torch.cat((state, x), dim=1)
        said = torch.where(features.is_odometry, self.segment_head(both).squeeze(1), self.closure_head(both).squeeze(1))
        return centred(_LARGEST * torch.tanh(said / _LARGEST), features)


def centred(value: Tensor, features: FineFeatures) -> Tensor:
    """Values minus their mean over the good edges of the same graph and kind; 0 for edges that are not good."""
    group = torch.where(features.is_good, 2 * features.graph + features.is_odometry, 0)
    good = features.is_good.to(value)
    num_groups = 2 * (int(features.graph.max()) + 1) if len(value) else 0
    total = value.new_zeros(num_groups).index_add(0, group, value * good)
    count = value.new_zeros(num_groups).index_add(0, group, good)
    return (value - (total / count.clamp(min=1))[group]) * good
