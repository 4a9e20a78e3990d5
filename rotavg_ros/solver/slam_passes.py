"""The passes of the SLAM refinement: each solves one sparse system, re-estimates the noise and judges every closure.

The system gives the corrections, and from a few more right-hand sides the effective resistance of every edge, that is
the variance of the difference of its ends. With it each closure is judged by what the rest of the graph predicts of it
(leave-one-out), which a long chain with one closure on it forgives and a dense neighbourhood does not, and both noise
variances are re-estimated by their redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.laplacian import FactorisedLaplacian, LaplacianPattern, probe_signs
from rotavg_ros.solver.noise_model import NoiseModel, outlier_share
from rotavg_ros.solver.residuals import log_rows, multiply_rows
from rotavg_ros.solver.slam_judging import (
    estimated_closure_variance,
    estimated_step_variance,
    exactness_of,
    judge,
    outlier_probability,
)

_NUM_PROBES = 48
# Residuals say nothing of noise or falsehood while the orientations still turn by more than this.
_SETTLED_STEP = np.radians(3.0)
_MAX_SETTLING_PASSES = 5
_CONVERGED_STEP = np.radians(0.002)
_CONVERGED_PROBABILITY = 2e-3
# What the rest of the graph predicts of an edge changes little from pass to pass: it is estimated anew this often, and
# before the passes end; also once probabilities have changed, in sum, by more than this share of the closures believed.
_PASSES_PER_PREDICTION = 4
_MAX_CHANGED_SHARE = 0.2
# From so many nodes on, a system is solved from the factorisation of a few passes before.
_ITERATING_PAYS = 4000
# … if the last pass changed no probability by more than this.
_NEAR = 0.2
# After an update's first pass a probability that would change by more than this goes half the way.
_SWING = 0.2
# An edge that alone holds two parts of the graph together has leverage 1; it cannot be judged by the others.
_MAX_LEVERAGE = 0.999
# In larger graphs the likeliest drift is near what is believed.
_MAX_NODES_TO_DRAW_AGAIN = 2000


@dataclass(frozen=True)
class SlamEstimate:
    """The refined closure graph (K key nodes, E edges).

    Attributes:
        correction: ``(K, 4)`` C.
        inlier_probability: ``(E,)`` that an edge is not a false one, which is what it weighs.
        outlier_probability: ``(E,)`` that its true noise exceeds 10° (``OUTLIER_ANGLE``), or that a segment slipped.
        noise: the estimated noise model.
        samples: ``(K, k)`` errors, in rad, as they might be: their second moments are the estimate's covariance.
        stated_step_variance: rad², what the samples are drawn with.
        common_share: share of the closures' error variance that neighbouring closures have in common.
        passes: number of sparse solves.
        steps: ``(E,)`` the graph's, more where closures err together.
        max_step_variance: what the step variance was kept under, rad².
        rank: ``(K,)`` where each key node stands in the order of elimination; None if there was none.
        exact_share: ``(E,)`` probability of a good closure to err no more than most.
    """

    correction: Tensor
    inlier_probability: np.ndarray
    outlier_probability: np.ndarray
    noise: NoiseModel
    samples: np.ndarray
    stated_step_variance: float
    common_share: float
    passes: int
    steps: np.ndarray
    max_step_variance: float
    rank: np.ndarray | None
    exact_share: np.ndarray


class Passes:
    """The unknowns of a SLAM graph's refinement, and what the last pass saw of them."""

    _system: FactorisedLaplacian
    _factorised: FactorisedLaplacian
    _samples: np.ndarray | None = None
    # Few edges are new, so that few weights change much from pass to pass.
    is_update = False

    def __init__(
        self,
        graph: ClosureGraph,
        correction: Tensor,
        inlier_probability: np.ndarray,
        noise: NoiseModel,
        prior_log_odds: np.ndarray,
        hold_noise: bool,
        rank: np.ndarray | None = None,
    ) -> None:
        self.graph, self.correction, self.noise, self.hold_noise = graph, correction, noise, hold_noise
        self.inlier_probability, self.prior_log_odds = inlier_probability, prior_log_odds
        self.pattern = LaplacianPattern(graph.num_nodes, graph.source, graph.target, graph.roots, rank)
        self.probes = probe_signs(graph.nodes[graph.source], graph.nodes[graph.target], _NUM_PROBES)
        self._measured = graph.residual.t().contiguous()
        self._source, self._target = torch.from_numpy(graph.source), torch.from_numpy(graph.target)
        self.residual = self._residual_vectors()
        # Of every edge if it is good: that it is no worse than most, and by how much less it weighs for that.
        self.exact_share, self.exactness = np.ones(len(graph.source)), np.ones(len(graph.source))
        self.passes = 0
        self._changed = 1.0
        self.prediction_variance = np.full(len(graph.source), np.inf)
        self._prediction_pass, self._changed_since_prediction = -_PASSES_PER_PREDICTION, 0.0
        self._discrepancy: np.ndarray | None = None

    @property
    def has_predictions(self) -> bool:
        """Whether there has been an estimate of what the rest of the graph predicts of each edge."""
        return self._prediction_pass > 0

    @property
    def samples(self) -> np.ndarray:
        """Errors ``(K, probes)`` as they might be under the weights last factorised; drawn when they are asked for."""
        if self._samples is None:
            self._samples = self._factorised.samples(self.probes)
        return self._samples

    def _residual_vectors(self) -> np.ndarray:
        """Rotation vectors ``(E, 3)`` in radians, of ``fine_net.edge_residual``."""
        rows = self.correction.t().contiguous()
        at_target = rows.index_select(1, self._target)
        at_target[:3].neg_()
        residual = multiply_rows(at_target, multiply_rows(self._measured, rows.index_select(1, self._source)))
        vectors = log_rows(residual.mul_(1 - 2 * (residual[3] < 0).to(residual)))
        return np.asarray(vectors.t().contiguous().numpy())

    def difference(self, values: np.ndarray) -> np.ndarray:
        """Node values ``(K, k)`` → differences over the edges, target − source ``(E, k)``."""
        return np.asarray(values[self.graph.target] - values[self.graph.source])

    def _variance(self, step_variance: float) -> np.ndarray:
        """Of every edge, ``(E,)`` rad²."""
        graph = self.graph
        return np.asarray(graph.steps * np.where(graph.is_odometry, step_variance, self.noise.closure_variance))

    def _weight(self, step_variance: float) -> np.ndarray:
        """``(E,)``."""
        return np.asarray(np.maximum(self.inlier_probability * self.exactness, 1e-9) / self._variance(step_variance))

    def estimate(self, share: float, max_step_variance: float) -> SlamEstimate:
        """What there is to say after the last pass."""
        step_variance = self.noise.step_variance
        if self.graph.num_nodes <= _MAX_NODES_TO_DRAW_AGAIN:
            # Where closures are few, drift is taken to be less than it probably is, for the sake of the verdicts.
            step_variance = max(step_variance, self.noise.likely_step_variance)
        if step_variance == self.noise.step_variance:
            samples = self.samples
        else:
            samples = self.pattern.factorize(self._weight(step_variance)).samples(self.probes)
        return SlamEstimate(
            rotations.normalize(self.correction),
            self.inlier_probability,
            self.outlier_probability(),
            self.noise,
            samples,
            step_variance,
            share,
            self.passes,
            self.graph.steps,
            max_step_variance,
            self.pattern.rank,
            self.exact_share,
        )

    def alternate(self, max_step_variance: float, max_passes: int) -> None:
        """Passes until convergence, or until there have been ``max_passes`` in all; at least one."""
        settled = False
        while True:
            refresh = settled or self._is_prediction_old() or self.passes + 1 >= max_passes
            moved, changed = self.one_pass(max_step_variance, refresh)
            settled = moved < _CONVERGED_STEP and changed < _CONVERGED_PROBABILITY
            if self.passes >= max_passes or (settled and refresh):
                return

    def _is_prediction_old(self) -> bool:
        believed = float(self.inlier_probability[self.graph.is_closure].sum())
        has_changed = self._changed_since_prediction > _MAX_CHANGED_SHARE * believed
        return has_changed or self.passes + 1 - self._prediction_pass >= _PASSES_PER_PREDICTION

    def one_pass(self, max_step_variance: float, refresh: bool) -> tuple[float, float]:
        """Solve, re-estimate the noise, judge; returns the largest correction (rad) and change of a probability.

        Args:
            refresh: whether to estimate anew what the rest of the graph predicts of each edge.
        """
        graph, noise = self.graph, self.noise
        variance, weight = self._variance(noise.step_variance), self._weight(noise.step_variance)
        # A pass after one that has not settled weighs as that did.
        if self.passes == 0 or not np.array_equal(weight, self._system.weight):
            is_near = (self._changed < _NEAR or self.is_update) and graph.num_nodes >= _ITERATING_PAYS
            if self.passes == 0 or refresh or not is_near:
                self._system = self._factorised = self.pattern.factorize(weight)
                self._samples = None if refresh else self._samples
            else:
                self._system = self.pattern.near(weight, self._factorised)
        step = self._system.fit(self.residual)
        self.correction = rotations.multiply(self.correction, rotations.exp(torch.from_numpy(step)))
        self.residual = self._residual_vectors()
        self.passes += 1
        moved = float(np.abs(step).max(initial=0.0))
        if moved > _SETTLED_STEP and self.passes <= _MAX_SETTLING_PASSES:
            self._changed = 1.0
            return moved, 1.0

        square = (self.residual**2).sum(axis=1)
        leverage = self._leverage(weight, refresh)
        odometry, closure = graph.is_odometry, graph.is_closure
        redundancy = self.inlier_probability * (1 - leverage)
        # A run's inflated variance is what its closures weigh, not what each of them errs.
        square_per_step = self.inlier_probability[odometry] * square[odometry] / graph.steps[odometry]
        step_variance, closure_variance = noise.step_variance, noise.closure_variance
        if not self.hold_noise:
            step_variance = min(
                max_step_variance, estimated_step_variance(square_per_step, redundancy[odometry], noise)
            )
            exact = self.exact_share[closure]
            closure_variance = estimated_closure_variance(
                square[closure], self.inlier_probability[closure] * exact, redundancy[closure] * exact, noise
            )
        share = outlier_share(self.inlier_probability[closure])
        self.noise = replace(noise, step_variance=step_variance, closure_variance=closure_variance, outlier_share=share)

        # What is left of the fit without the edge itself, and how far that may be off.
        predicted_square = np.minimum(square / (1 - leverage) ** 2, np.pi**2)
        scale = np.where(odometry, 1.0, self.noise.closure_variance / noise.closure_variance)
        judged = judge(self.noise, predicted_square, scale * variance, self.prediction_variance)
        if judged.exact_share is not None:
            self.exact_share = np.where(closure, judged.exact_share, 1.0)
            self.exactness = exactness_of(self.exact_share, self.noise.closure_variance)
        probability = np.where(closure, expit(judged.log_odds + self.prior_log_odds), self.inlier_probability)
        if self.is_update and self.passes > 1:
            # Closures of which each is good if the other is not would change places from update to update.
            is_swinging = np.abs(probability - self.inlier_probability) > _SWING
            probability = np.where(is_swinging, (probability + self.inlier_probability) / 2, probability)
        change = np.abs(probability - self.inlier_probability)
        self._changed = changed = float(change.max(initial=0.0))
        self._changed_since_prediction += float(change.sum())
        self.inlier_probability = probability
        self._discrepancy = np.sqrt(predicted_square)
        return moved, changed

    def _leverage(self, weight: np.ndarray, refresh: bool) -> np.ndarray:
        """Of every edge, ``(E,)``; and the variance of what the rest of the graph predicts of it, new or as it was.

        That variance does not depend on the edge's own weight, so it stays right where an edge's verdict is changed.
        """
        if not refresh:
            gain = weight * self.prediction_variance
            return np.asarray(np.minimum(gain / (1 + gain), _MAX_LEVERAGE))
        # A few columns at a time, which stay in a core's cache.
        parts = np.array_split(self.samples, _NUM_PROBES // 4, axis=1)
        resistance = sum((self.difference(part) ** 2).sum(axis=1) for part in parts) / _NUM_PROBES
        leverage = np.clip(weight * resistance, 0.0, _MAX_LEVERAGE)
        self.prediction_variance, self._prediction_pass = resistance / (1 - leverage), self.passes
        self._changed_since_prediction = 0.0
        return np.asarray(leverage)

    def outlier_probability(self) -> np.ndarray:
        """That a closure's true noise exceeds 10° (``OUTLIER_ANGLE``), or that a segment slipped, ``(E,)``."""
        good = self.inlier_probability
        if self._discrepancy is None:
            return np.asarray(1 - good)
        wrong = outlier_probability(self.noise, good, self._discrepancy, self.prediction_variance)
        return np.asarray(np.where(self.graph.is_closure, wrong, 1 - good))
