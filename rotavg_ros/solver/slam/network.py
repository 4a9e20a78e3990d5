"""CleanNet of the SLAM profile: judges loop closures by which of them agree.

Along a chain of 10⁴ keyframes, four layers do not reach round a loop. So the SLAM network passes its messages between
*closures*: each receives those of the closures nearest to it along the odometry (``agreement.py``), and has its own
discrepancy with the odometry as a feature. All inputs are in units of the estimated noise, so one network serves all
scales.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.neurora.message_passing import HIDDEN_WIDTH, DirectedEdges, MessagePassingNetwork
from rotavg_ros.solver.neurora.network_store import StoredNetwork
from rotavg_ros.solver.neurora.tiled.passes import node_states
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs
from rotavg_ros.solver.slam.noise.model import NoiseModel, judge_by_chain

NUM_CLOSURE_FEATURES = 7
NUM_PAIR_FEATURES = 4
_LOG_ODDS_SCALE = 8.0


@dataclass(frozen=True)
class ClosureFeatures:
    """Input of :class:`SlamCleanNet` for C closures and P agreement pairs (float32).

    Attributes:
        closures: ``(C, 7)`` features of each closure.
        pairs: ``(P, 4)`` features of each pair.
        edges: messages, which run second → first.
    """

    closures: Tensor
    pairs: Tensor
    edges: DirectedEdges


def closure_features(
    noise: NoiseModel, squared_angle: np.ndarray, path_steps: np.ndarray, pairs: AgreementPairs
) -> ClosureFeatures:
    """Features of ``(C,)`` closures: discrepancy with the odometry in rad², odometry steps passed."""
    count = len(squared_angle)
    finite = np.isfinite(path_steps)
    drift = np.where(finite, path_steps, 0.0) * noise.step_variance
    variance = drift + noise.closure_variance
    closures = np.stack(
        (
            np.clip(judge_by_chain(noise, squared_angle, path_steps) / _LOG_ODDS_SCALE, -3, 1.5),
            np.where(finite, np.arcsinh(np.sqrt(squared_angle / variance)), 0.0),
            # Between chains that only closures join, the angle depends on which closure the forest happens to use.
            np.where(finite, np.sqrt(np.minimum(squared_angle, np.pi**2)), 0.0),
            np.where(finite, np.log10(1e-3 + drift / noise.closure_variance), 3.0),
            np.full(count, np.log10(np.sqrt(noise.closure_variance)) + 1.5),
            np.full(count, noise.prior_log_odds / 2),
            np.full(count, (noise.components - 2.0)),
        ),
        axis=1,
    )
    pair_variance = pairs.steps * noise.step_variance + 2 * noise.closure_variance
    agreement = noise.inlier_log_odds(pairs.squared_angle, pair_variance)
    pair_features = np.stack(
        (
            np.clip(agreement / _LOG_ODDS_SCALE, -3, 1.5),
            np.arcsinh(np.sqrt(pairs.squared_angle / pair_variance)),
            np.log10(1 + pairs.steps),
            np.log10(1e-3 + pairs.steps * noise.step_variance / noise.closure_variance),
        ),
        axis=1,
    )
    first, second = torch.from_numpy(pairs.first), torch.from_numpy(pairs.second)
    degree = torch.bincount(first, minlength=count)
    inverse_degree = torch.where(degree > 0, 1 / degree.clamp(min=1).float(), 0.0)[:, None]
    return ClosureFeatures(
        torch.from_numpy(closures).float(),
        torch.from_numpy(pair_features).float(),
        DirectedEdges(second, first, inverse_degree),
    )


class SlamCleanNet(StoredNetwork):
    """Predicts the log-odds that each loop closure is false."""

    NAME = "slam-clean-net"

    def __init__(self) -> None:
        super().__init__()
        self.network = MessagePassingNetwork(NUM_CLOSURE_FEATURES, NUM_PAIR_FEATURES)
        self.outlier_head = nn.Linear(HIDDEN_WIDTH + NUM_CLOSURE_FEATURES, 1)

    def forward(self, features: ClosureFeatures) -> Tensor:
        """``(C,)`` log-odds that each closure is false."""
        states, _ = self.network(features.closures, features.pairs, features.edges)
        log_odds: Tensor = self.outlier_head(torch.cat((states, features.closures), dim=1))
        return log_odds.squeeze(1)


def false_log_odds(network: SlamCleanNet, features: ClosureFeatures) -> Tensor:
    """``(C,)`` log-odds that each closure is false; messages must be sorted by the closure that receives them."""
    edges = features.edges
    arriving = torch.bincount(edges.target, minlength=edges.num_nodes).cumsum(0)
    # Each message has its own row; none is the reverse of another.
    sorted_edges = SortedEdges(
        torch.cat((arriving.new_zeros(1), arriving)).int(),
        edges.source.int(),
        torch.arange(len(edges.source), dtype=torch.int32),
        torch.zeros(len(edges.source), dtype=torch.bool),
    )
    states = node_states(network.network, features.closures, features.pairs, sorted_edges)
    log_odds: Tensor = network.outlier_head(torch.cat((states, features.closures), dim=1))
    return log_odds.squeeze(1)
