"""A solved graph with known truth, on which FineNet is trained: how its variances change the error of orientations.

At a labelling's optimum the solve is linear in the residuals, so one sparse solve gives the result of other weights.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import FineFeatures, fine_features
from rotavg_ros.solver.slam.fine_net.scale import Told
from rotavg_ros.solver.slam.fine_net.sparse_solve import sparse_solve
from rotavg_ros.solver.slam.fine_net.tuning import Tuned, told
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.posterior.rows import residuals, variances
from rotavg_ros.solver.slam.posterior.system import NormalEquations

# Weight of a false closure, or of a slipped segment, relative to a good one.
_NOTHING = 1e-10
# Added to errors before their logarithm, rad, so that smaller ones are as good as zero.
_FLOOR = float(np.radians(0.05))
_WEISZFELD_STEPS = 4
# Log ratio of true to predicted variance beyond which the divergence grows only linearly.
_FAR = 2.0


@dataclass(frozen=True)
class Truth:
    """The truth of a graph with K key nodes and E edges.

    Attributes:
        correction: ``(4, K)`` true corrections of the odometry's orientations, in any gauge.
        variance: ``(E,)`` rad² per component, of each edge's actual noise; NaN where unknown or false.
    """

    correction: np.ndarray
    variance: np.ndarray


class Losses(NamedTuple):
    """The losses of one graph, given predicted variances.

    Attributes:
        log_error: log rad, of the mean error.
        log_expected: log rad, of the root mean square error if edges erred anew with their true variances. On one
            graph this measures the quality of weights far more exactly than ``log_error``, but does not tell whether
            they suit the errors that actually occurred.
        nats: per edge, divergence from normal densities with the true variances, summed over the means of both kinds.
    """

    log_error: Tensor
    log_expected: Tensor
    nats: Tensor


@dataclass(frozen=True)
class FineSample:
    """A solved graph (K key nodes, E edges, R runs).

    Attributes:
        features: the network's input.
        told: the prediction of each edge by all others.
        system: rows of the sparse solve.
        residual: ``(E + R, 3)`` rad.
        used: ``(E,)`` rad², inverse weights of edges as good ones.
        runs: ``(R,)`` rad², variances of common errors.
        common: ``(E,)`` rad², variance of the error that each edge shares with its run.
        turn: ``(K, 3)`` rad, turns of the key nodes that would lead to the truth.
        share: ``(K,)`` share of the view-graph's nodes at each key node; nodes within segments count for both ends, in
            proportion to their nearness.
        true_variance: ``(E,)`` rad²; NaN where unknown.
    """

    features: FineFeatures
    told: Told
    system: NormalEquations
    residual: Tensor
    used: Tensor
    runs: Tensor
    common: Tensor
    turn: Tensor
    share: Tensor
    true_variance: Tensor

    @classmethod
    def of(cls, tuned: Tuned, truth: Truth) -> FineSample:
        """From a labelling at its optimum."""
        problem, state = tuned.problem, tuned.state
        evidence, noise = Evidence.of(problem, state), state.noise
        system, num_edges = problem.system(noise), len(evidence.own)
        gauge = _gauge(truth.correction, state.correction)
        aligned = quaternion_rows.multiply(truth.correction, np.repeat(gauge, len(problem.graph.nodes), axis=1))
        turn = quaternion_rows.log(quaternion_rows.multiply(quaternion_rows.inverse(state.correction), aligned)).T
        return cls(
            fine_features(evidence),
            told(evidence, problem.priors),
            system,
            torch.from_numpy(residuals(problem, state)),
            torch.from_numpy(1 / evidence.weight),
            torch.from_numpy(variances(problem, noise)[num_edges:]),
            torch.from_numpy(system.shared * noise.common_share * noise.closure_variance),
            torch.from_numpy(np.ascontiguousarray(turn)),
            torch.from_numpy(_share(problem.drawn(noise))),
            torch.from_numpy(np.where(state.is_good, truth.variance, np.nan)),
        )

    def losses(self, log_noise: Tensor, fresh: Tensor) -> Losses:
        """The losses under given variances.

        Args:
            log_noise: ``(E,)`` float64, logarithms of variances relative to those used without FineNet.
            fresh: ``(E + R, 3, F)`` standard normal samples, from which other errors of the edges are drawn.
        """
        kind = self.features.is_odometry.long()
        variance = self.used * log_noise.exp()
        scale = self.told.log_scale(self.used, variance).exp()
        variance, runs = variance * scale[kind], self.runs * scale[0]
        weight = torch.cat((torch.where(self.told.good > 0, 1 / variance, _NOTHING / self.used), 1 / runs))
        drawn = torch.cat((self.true_variance.nan_to_num(), 0 * self.runs)).sqrt()[:, None, None] * fresh
        columns = torch.cat((self.residual, drawn.reshape(len(drawn), -1)), dim=1)
        solved = sparse_solve(self.system, weight, columns)[: len(self.turn)]
        turned = self.turn - solved[:, :3]
        error = (self.share * _length(turned - self._middle(turned.detach()))).sum()
        others = solved[:, 3:]
        others = others - (self.share[:, None] * others).sum(dim=0)
        expected = (self.share[:, None] * others**2).sum(dim=0).mean().sqrt()
        nats = self._nats(variance + self.common * scale[kind])
        return Losses(torch.log(error + _FLOOR), torch.log(expected + _FLOOR), nats)

    def errors(self) -> tuple[float, float]:
        """Mean and largest error of the nodes' current orientations, rad, relative to their median."""
        error = _length(self.turn - self._middle(self.turn))
        return float((self.share * error).sum()), float(error.max())

    def _nats(self, variance: Tensor) -> Tensor:
        counts = torch.isfinite(self.true_variance)
        off = (self.true_variance[counts] / variance[counts]).log()
        near = off.clamp(max=_FAR)
        nats = self.told.components / 2 * (near.exp() * (1 + off - near) - 1 - off)
        kinds = [nats[self.features.is_odometry[counts]], nats[~self.features.is_odometry[counts]]]
        return torch.stack([kind.mean() for kind in kinds if len(kind)]).sum()

    def _middle(self, turned: Tensor) -> Tensor:
        """``(3,)`` geometric median of turns ``(K, 3)``, so that no gauge is learned (Weiszfeld's algorithm)."""
        share = self.share[:, None]
        middle = (share * turned).sum(dim=0)
        for _ in range(_WEISZFELD_STEPS):
            weight = share / (_length(turned - middle)[:, None] + _FLOOR)
            middle = (weight * turned).sum(dim=0) / weight.sum()
        return middle


def _length(vectors: Tensor) -> Tensor:
    # The gradient of the root is infinite at zero.
    return ((vectors**2).sum(dim=-1) + 1e-16).sqrt()


def _gauge(correction: np.ndarray, like: np.ndarray) -> np.ndarray:
    """``(4, 1)`` rotation that brings corrections ``(4, K)`` nearest to others, when multiplied from the right."""
    apart = quaternion_rows.multiply(quaternion_rows.inverse(correction), like)
    return np.asarray(np.linalg.eigh(apart @ apart.T)[1][:, -1:])


def _share(graph: ClosureGraph) -> np.ndarray:
    share = np.bincount(graph.above, 1 - graph.fraction, graph.num_nodes)
    share += np.bincount(graph.below, graph.fraction, graph.num_nodes)
    return np.asarray(share / share.sum())
