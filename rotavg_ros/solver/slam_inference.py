"""The SLAM CleanNet as solves run it: what its ``forward`` computes, by the tiled passes of ``inference.py``."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.inference import node_states
from rotavg_ros.solver.slam_clean_net import ClosureFeatures, SlamCleanNet
from rotavg_ros.solver.sorted_edges import SortedEdges


def false_log_odds(network: SlamCleanNet, features: ClosureFeatures) -> Tensor:
    """Log-odds of every closure to be false ``(C,)``; messages must be sorted by the closure that gets them."""
    edges = features.edges
    arriving = torch.bincount(edges.target, minlength=edges.num_nodes).cumsum(0)
    # Every message is a row of its own; none is another one reversed.
    sorted_edges = SortedEdges(
        torch.cat((arriving.new_zeros(1), arriving)).int(),
        edges.source.int(),
        torch.arange(len(edges.source), dtype=torch.int32),
        torch.zeros(len(edges.source), dtype=torch.bool),
    )
    states = node_states(network.network, features.closures, features.pairs, sorted_edges)
    log_odds: Tensor = network.outlier_head(torch.cat((states, features.closures), dim=1))
    return log_odds.squeeze(1)
