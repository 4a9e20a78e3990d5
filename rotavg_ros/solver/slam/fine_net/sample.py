"""A solved graph of which the truth is known, as FineNet is trained on it: what its variances make of orientations.

At a labelling's optimum the solve is linear in residuals, so that of other weights comes out by one sparse solve. What
others say of an edge is held meanwhile, as in one step of expectation propagation.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.slam.fine_net.evidence import Evidence
from rotavg_ros.solver.slam.fine_net.features import FineFeatures, fine_features
from rotavg_ros.solver.slam.fine_net.sparse_solve import sparse_solve
from rotavg_ros.solver.slam.fine_net.tuning import Tuned
from rotavg_ros.solver.slam.posterior.rows import residuals, variances
from rotavg_ros.solver.slam.posterior.system import NormalEquations

# The variance of each kind follows the weights so many times, as its estimate does from solve to solve.
_NOISE_ROUNDS = 3
# What a false closure weighs of a good one, and a slipped segment.
_NOTHING = 1e-10
# Errors below this, rad, are as good as none.
_FLOOR = float(np.radians(0.05))
_WEISZFELD_STEPS = 4


@dataclass(frozen=True)
class Truth:
    """What is known of a solved graph (K key nodes, E edges, k components).

    Attributes:
        turn: ``(K, 3)`` rad, by which the key nodes would have to turn.
        share: ``(K,)`` of the view-graph's nodes that lie at each, those in segments by how near they are; adds up to 1.
        error_square: ``(E,)`` rad², of each edge's error.
        counts: ``(E,)`` bool, whose errors are drawn from a good edge's density.
    """

    turn: Tensor
    share: Tensor
    error_square: Tensor
    counts: Tensor


@dataclass(frozen=True)
class FineSample:
    """One graph (E edges, R runs).

    Attributes:
        features: what the network sees.
        system: rows of the sparse solve.
        residual: ``(E + R, 3)`` rad.
        own: ``(E + R,)`` rad², variances as estimated.
        good: ``(E,)`` 1 for good closures and sound segments, else 0.
        square, predicted: ``(E,)`` rad², what others say of each edge.
        common: ``(E,)`` rad², variance of the error that each edge has in common with its run.
        tails: ``(E,)``.
        tail_ratio: τ.
        components: k.
        truth: what it is trained on.
    """

    features: FineFeatures
    system: NormalEquations
    residual: Tensor
    own: Tensor
    good: Tensor
    square: Tensor
    predicted: Tensor
    common: Tensor
    tails: Tensor
    tail_ratio: float
    components: int
    truth: Truth

    @classmethod
    def of(cls, tuned: Tuned, correction: np.ndarray, counts: np.ndarray) -> FineSample:
        """A labelling at rest.

        Args:
            tuned: the labelling.
            correction: ``(4, K)`` true corrections of the odometry's orientations, in any gauge.
            counts: ``(E,)`` bool, edges that are as good as the labelling has them.
        """
        problem, state = tuned.problem, tuned.state
        evidence, noise = Evidence.of(problem, state), state.noise
        system, num_edges = problem.system(noise), len(evidence.own)
        aligned = _aligned(correction, state.correction)
        true_state = type(state)(aligned, np.zeros_like(state.common), state.trusted, noise, state.others)
        error = residuals(problem, true_state)[:num_edges]
        turn = quaternion_rows.log(quaternion_rows.multiply(quaternion_rows.inverse(state.correction), aligned)).T
        shared = system.shared * noise.common_share * noise.closure_variance
        truth = Truth(
            torch.from_numpy(np.ascontiguousarray(turn)),
            torch.from_numpy(_share(problem.drawn(noise))),
            torch.from_numpy((error**2).sum(axis=1)),
            torch.from_numpy(counts & state.is_good),
        )
        return cls(
            fine_features(evidence),
            system,
            torch.from_numpy(residuals(problem, state)),
            torch.from_numpy(variances(problem, noise)),
            torch.from_numpy(state.is_good.astype(np.float64)),
            torch.from_numpy(evidence.square),
            torch.from_numpy(evidence.predicted),
            torch.from_numpy(shared),
            torch.from_numpy(evidence.tails),
            problem.priors.tail_ratio,
            problem.components,
            truth,
        )

    def losses(self, log_relative: Tensor) -> tuple[Tensor, Tensor]:
        """What variances are worth: the logarithm of the mean error, and nats per edge that their true errors cost.

        Args:
            log_relative: ``(E,)`` float64, logarithms of variances over the estimated ones.
        """
        num_edges = len(self.good)
        own = self.own[:num_edges] * log_relative.exp()
        scale = self._rescaled(own)
        own = own * scale[:num_edges]
        weight, _, _ = self._sites(own)
        weight = self.good * weight + (1 - self.good) * _NOTHING * weight.detach()
        runs = 1 / (self.own[num_edges:] * scale[num_edges:])
        step = sparse_solve(self.system, torch.cat((weight, runs)), self.residual)
        turned = self.truth.turn - step[: len(self.truth.turn)]
        error = _length(turned - self._middle(turned.detach()))
        return torch.log((self.truth.share * error).sum() + _FLOOR), self._nats(own + self.common * scale[:num_edges])

    def _nats(self, variance: Tensor) -> Tensor:
        """Of the true errors under mixtures with tails, less what they cost as estimated; both kinds count alike."""
        cost = _log_density(self, variance) - _log_density(self, self.own[: len(variance)] + self.common)
        is_odometry, counts = self.features.is_odometry, self.truth.counts
        kinds = [cost[counts & is_odometry], cost[counts & ~is_odometry]]
        return -torch.stack([kind.mean() for kind in kinds if len(kind)]).sum()

    def _rescaled(self, own: Tensor) -> Tensor:
        """``(E + R,)`` by what either kind's variance changes when it is estimated anew under ``own`` ``(E,)``."""
        kinds = [self.features.is_odometry, ~self.features.is_odometry]
        scale = torch.ones_like(self.own)
        closures = torch.cat((kinds[1], torch.ones(len(self.own) - len(own), dtype=torch.bool)))
        for _ in range(_NOISE_ROUNDS):
            _, shrinkage, misfit = self._sites(own * scale[: len(own)])
            for rows, of_kind in ((torch.cat((kinds[0], torch.zeros_like(closures[len(own) :]))), kinds[0]), (closures, kinds[1])):
                used = self.good * of_kind
                ratio = ((used * misfit).sum() + 1) / (self.components * (used * shrinkage).sum() + 1)
                scale = torch.where(rows, scale * ratio, scale)
        return scale

    def _sites(self, own: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Weights, shrinkages and misfits ``(E,)`` as :class:`rotavg_ros.solver.slam.posterior.densities.Sites` has."""
        near_total, far_total = own + self.predicted, self.tail_ratio * own + self.predicted
        exact = torch.sigmoid(
            _log_normal(self.square, near_total, self.components)
            - _log_normal(self.square, far_total, self.components)
            + torch.log1p(-self.tails)
            - self.tails.clamp(min=1e-30).log()
        )
        near, far = exact / near_total, (1 - exact) / far_total
        shrinkage = own * (near + self.tail_ratio * far)
        misfit = self.square * own * (near / near_total + self.tail_ratio * far / far_total)
        return (near + far) / shrinkage, shrinkage, misfit

    def _middle(self, turned: Tensor) -> Tensor:
        """``(3,)`` geometric median of turns ``(K, 3)``: no gauge is learned (Weiszfeld)."""
        share = self.truth.share[:, None]
        middle = (share * turned).sum(dim=0)
        for _ in range(_WEISZFELD_STEPS):
            weight = share / (_length(turned - middle)[:, None] + _FLOOR)
            middle = (weight * turned).sum(dim=0) / weight.sum()
        return middle


def _log_normal(square: Tensor, variance: Tensor, components: int) -> Tensor:
    return -square / (2 * variance) - components / 2 * torch.log(variance)


def _log_density(sample: FineSample, variance: Tensor) -> Tensor:
    """``(E,)`` nats, of true errors; the tails' constant left out."""
    square, k = sample.truth.error_square, sample.components
    exact = _log_normal(square, variance, k) + torch.log1p(-sample.tails)
    tail = _log_normal(square, sample.tail_ratio * variance, k) + sample.tails.clamp(min=1e-30).log()
    return torch.logaddexp(exact, tail)


def _length(vectors: Tensor) -> Tensor:
    return ((vectors**2).sum(dim=-1) + 1e-16).sqrt()


def _aligned(correction: np.ndarray, like: np.ndarray) -> np.ndarray:
    """Corrections ``(4, K)`` in the gauge in which they are nearest to others (chordal mean)."""
    gauge = quaternion_rows.multiply(quaternion_rows.inverse(correction), like)
    mean = np.linalg.eigh(gauge @ gauge.T)[1][:, -1:]
    return quaternion_rows.normalize(quaternion_rows.multiply(correction, np.repeat(mean, correction.shape[1], axis=1)))


def _share(graph: object) -> np.ndarray:
    from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph

    assert isinstance(graph, ClosureGraph)
    share = np.bincount(graph.above, 1 - graph.fraction, graph.num_nodes)
    share += np.bincount(graph.below, graph.fraction, graph.num_nodes)
    return np.asarray(share / share.sum())
