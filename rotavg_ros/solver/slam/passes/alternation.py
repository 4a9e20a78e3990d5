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
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.laplacian import FactorisedLaplacian
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.judging import (
    estimated_closure_variance,
    estimated_step_variance,
    exactness_of,
    judge,
    outlier_probability,
    tail_ratio,
)
from rotavg_ros.solver.slam.noise.model import NoiseModel, outlier_share
from rotavg_ros.solver.slam.noise.stated_precision import StatedTrust
from rotavg_ros.solver.slam.passes.system import System, leverage

# Residuals say nothing of noise or falsehood while the orientations still turn by more than this.
_SETTLED_STEP = np.radians(3.0)
_MAX_SETTLING_PASSES = 5
_CONVERGED_STEP = np.radians(0.01)
# … or by this share of what a step of odometry errs.
_CONVERGED_NOISE_SHARE = 0.05
_CONVERGED_PROBABILITY = 0.01
# What the rest of the graph predicts of an edge changes little from pass to pass: it is estimated anew this often, and
# before the passes end; also once probabilities have changed, in sum, by more than this share of the closures believed.
_PASSES_PER_PREDICTION = 4
_MAX_CHANGED_SHARE = 0.2
# A system is solved from the factorisation of a few passes before if the last pass changed no probability by more.
_NEAR = 0.2
# In an update, the probability of an older closure that would change by more than this goes half the way.
_SWING = 0.02
# What the most certainly false edge weighs, of what it would if it were good.
_MIN_TRUST = 1e-9


@dataclass(frozen=True)
class Verdicts:
    """On a closure graph (K key nodes, E edges).

    Attributes:
        correction: ``(K, 4)`` C.
        inlier_probability: ``(E,)`` p_e, that an edge is not of the noise model's false component: a factor of its
            weight.
        outlier_probability: ``(E,)`` that its true noise exceeds 10° (``OUTLIER_ANGLE``), or that a segment slipped.
        noise: the estimated noise model.
        steps: ``(E,)`` the graph's, more where closures err together.
        exact_share: ``(E,)`` probability of a good closure to err no more than most.
        prediction_variance: ``(E,)`` rad², of what the rest of the graph predicts of each edge.
    """

    correction: Tensor
    inlier_probability: np.ndarray
    outlier_probability: np.ndarray
    noise: NoiseModel
    steps: np.ndarray
    exact_share: np.ndarray
    prediction_variance: np.ndarray


@dataclass(frozen=True)
class SlamEstimate(Verdicts):
    """The refined closure graph.

    Attributes:
        samples: ``(K, k)`` errors, in rad, as they might be: their second moments are the estimate's covariance.
        stated_step_variance: rad², what the samples are drawn with.
        common_share: share of the closures' error variance that neighbouring closures have in common.
        trust: how far the variances that closures state are believed.
        passes: number of sparse solves.
        max_step_variance: what the step variance was kept under, rad².
        rank: ``(K,)`` where each key node stands in the order of elimination; None if there was none.
        factorised: the last factorisation.
        in_false_group: ``(E,)`` bool, believed closures that are false if the group they belong to is judged as one;
            looked for once the first passes have settled.
    """

    samples: np.ndarray
    stated_step_variance: float
    common_share: float
    trust: StatedTrust
    passes: int
    max_step_variance: float
    rank: np.ndarray | None
    factorised: FactorisedLaplacian
    in_false_group: np.ndarray


@dataclass(frozen=True)
class Start:
    """Where passes begin (K key nodes, E edges).

    Attributes:
        graph: the closure graph.
        correction: ``(K, 4)``; identities for the odometry itself.
        inlier_probability: ``(E,)``; that of odometry is kept.
        noise: to begin with.
        network_log_odds: ``(E,)`` of each edge to be good, beyond the common outlier share; ±inf decide it.
        exact_share: ``(E,)`` probability of a good closure to err no more than most; default: 1.
        is_new: ``(E,)`` bool, in an update the closures that have just come; None: this is no update.
    """

    graph: ClosureGraph
    correction: Tensor
    inlier_probability: np.ndarray
    noise: NoiseModel
    network_log_odds: np.ndarray
    exact_share: np.ndarray | None = None
    is_new: np.ndarray | None = None

    @property
    def exactness(self) -> np.ndarray:
        """What every edge weighs for erring no more than most, ``(E,)``."""
        if self.exact_share is None:
            return np.ones(len(self.graph.source))
        return exactness_of(self.exact_share, tail_ratio(self.noise.closure_variance * self.graph.own_steps))

    @property
    def weight(self) -> np.ndarray:
        """Of every edge, ``(E,)`` rad⁻²."""
        return edge_weight(self.inlier_probability * self.exactness, edge_variance(self.graph, self.noise))


class Passes:
    """The unknowns of a SLAM graph's refinement, and what the last pass saw of them.

    Args:
        hold_noise: keep both variances as given.
    """

    def __init__(self, start: Start, system: System, hold_noise: bool) -> None:
        graph = start.graph
        self.graph, self.noise, self.hold_noise = graph, start.noise, hold_noise
        self.inlier_probability, self.network_log_odds = start.inlier_probability, start.network_log_odds
        self.system = system
        # In an update few edges are new, so that few weights change much from pass to pass.
        self._is_new = start.is_new
        self._closure = np.flatnonzero(graph.is_closure)
        # Components in rows.
        self._correction = np.ascontiguousarray(start.correction.numpy().T)
        self._measured = np.ascontiguousarray(graph.residual.numpy().T)
        self.residual = self._residual_vectors()
        # Of every edge if it is good: that it is no worse than most, and by how much less it weighs for that.
        self.exact_share = np.ones(len(graph.source)) if start.exact_share is None else start.exact_share.copy()
        self.exactness = start.exactness
        self.passes = 0
        self._changed = 1.0
        self._prediction_pass, self._changed_since_prediction = -_PASSES_PER_PREDICTION, 0.0
        self._discrepancy: np.ndarray | None = None

    @property
    def has_predictions(self) -> bool:
        """Whether there has been an estimate of what the rest of the graph predicts of each edge."""
        return self._prediction_pass > 0

    @property
    def tail_ratio(self) -> np.ndarray:
        """``(E,)``, see :func:`~rotavg_ros.solver.slam.noise.judging.tail_ratio`; on odometry without meaning."""
        return tail_ratio(self.noise.closure_variance * self.graph.own_steps)

    @property
    def discrepancy(self) -> np.ndarray:
        """``(C,)`` rad, of every closure with what the rest of the graph predicts of it."""
        assert self._discrepancy is not None
        return self._discrepancy

    def _residual_vectors(self) -> np.ndarray:
        """Rotation vectors ``(E, 3)`` in radians, of ``residuals.edge_residual``."""
        residual = quaternion_rows.residual(self._correction, self._measured, self.graph.source, self.graph.target)
        return np.ascontiguousarray(quaternion_rows.log(residual).T)

    def difference(self, values: np.ndarray) -> np.ndarray:
        """Node values ``(K, k)`` → differences over the edges, target − source ``(E, k)``."""
        return np.asarray(values.take(self.graph.target, axis=0) - values.take(self.graph.source, axis=0))

    def weight(self, noise: NoiseModel) -> np.ndarray:
        """Of every edge, ``(E,)`` rad⁻²."""
        return edge_weight(self.inlier_probability * self.exactness, edge_variance(self.graph, noise))

    def weigh_anew(self, graph: ClosureGraph, noise: NoiseModel | None = None) -> None:
        """Go on with other variances of the same edges, and another noise where one is given."""
        self.graph, self.noise = graph, self.noise if noise is None else noise

    def verdicts(self) -> Verdicts:
        """What there is to say after the last pass."""
        return Verdicts(
            rotations.canonical(torch.from_numpy(np.ascontiguousarray(self._correction.T))),
            self.inlier_probability,
            self.outlier_probability(),
            self.noise,
            self.graph.steps,
            self.exact_share,
            self.system.prediction_variance,
        )

    def alternate(self, max_step_variance: float, max_passes: int) -> None:
        """Passes until convergence, or until there have been ``max_passes`` in all; at least one."""
        settled = False
        while True:
            # The last pass of all needs no predictions of its own right after new ones.
            is_last = self.passes + 1 >= max_passes and self._prediction_pass < self.passes - 1
            refresh = settled or self._is_prediction_old() or is_last
            moved, changed = self.one_pass(max_step_variance, refresh)
            converged_step = max(_CONVERGED_STEP, _CONVERGED_NOISE_SHARE * np.sqrt(self.noise.step_variance))
            settled = moved < converged_step and changed < _CONVERGED_PROBABILITY
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
        variance, weight = edge_variance(graph, noise), self.weight(noise)
        is_near = self._changed < _NEAR or self._is_new is not None
        step = self.system.solve(weight, self.residual, refresh=refresh, is_near=is_near)
        turned = quaternion_rows.multiply(self._correction, quaternion_rows.exp(step.T))
        self._correction = quaternion_rows.normalize(turned)
        self.residual = self._residual_vectors()
        self.passes += 1
        moved = float(np.abs(step).max(initial=0.0))
        if moved > _SETTLED_STEP and self.passes <= _MAX_SETTLING_PASSES:
            self._changed = 1.0
            return moved, 1.0

        square = (self.residual**2).sum(axis=1)
        if refresh:
            self.system.predict(weight)
            self._prediction_pass, self._changed_since_prediction = self.passes, 0.0
        prediction_variance = self.system.prediction_variance
        leave_out = 1 - leverage(weight, prediction_variance)
        self.noise = replace(noise, outlier_share=outlier_share(self.inlier_probability[self._closure]))
        if not self.hold_noise:
            self._estimate_noise(square, self.inlier_probability * leave_out, max_step_variance)

        # Verdicts: what is left of the fit without the edge itself, and how far that may be off.
        closure = self._closure
        predicted_square = np.minimum(square[closure] / leave_out[closure] ** 2, np.pi**2)
        scale = self.noise.closure_variance / noise.closure_variance
        judged = judge(
            self.noise,
            predicted_square,
            scale * variance[closure],
            prediction_variance[closure],
            self.tail_ratio[closure],
        )
        if judged.exact_share is not None:
            self.exact_share[closure] = judged.exact_share
            self.exactness = exactness_of(self.exact_share, self.tail_ratio)
        before = self.inlier_probability[closure]
        # p_e. No edge is switched off: p_e is a factor of its weight in the next pass.
        probability = expit(judged.log_odds + self.network_log_odds[closure])
        if self._is_new is not None:
            # Closures of which each is good if the other is not would change places from update to update.
            is_swinging = ~self._is_new[closure] & (np.abs(probability - before) > _SWING)
            probability = np.where(is_swinging, (probability + before) / 2, probability)
        change = np.abs(probability - before)
        self.inlier_probability = self.inlier_probability.copy()
        self.inlier_probability[closure] = probability
        self._changed = changed = float(change.max(initial=0.0))
        self._changed_since_prediction += float(change.sum())
        self._discrepancy = np.sqrt(predicted_square)
        return moved, changed

    def _estimate_noise(self, square: np.ndarray, redundancy: np.ndarray, max_step_variance: float) -> None:
        """Both variances, from the residuals' squares, rad², and the redundancies that they leave; ``(E,)`` each."""
        graph, noise = self.graph, self.noise
        odometry, closure = graph.is_odometry, self._closure
        # A run's inflated variance is what its closures weigh, not what each of them errs.
        square = square / graph.own_steps
        step_variance = estimated_step_variance(
            self.inlier_probability[odometry] * square[odometry], redundancy[odometry], noise
        )
        exact = self.exact_share[closure]
        closure_variance = estimated_closure_variance(
            square[closure], self.inlier_probability[closure] * exact, redundancy[closure] * exact, noise
        )
        self.noise = replace(
            noise, step_variance=min(max_step_variance, step_variance), closure_variance=closure_variance
        )

    def outlier_probability(self) -> np.ndarray:
        """That a closure's true noise exceeds 10° (``OUTLIER_ANGLE``), or that a segment slipped, ``(E,)``."""
        probability = 1 - self.inlier_probability
        if self._discrepancy is not None:
            closure = self._closure
            probability[closure] = outlier_probability(
                self.inlier_probability[closure],
                self._discrepancy,
                self.noise.closure_variance * self.graph.own_steps[closure],
                self.system.prediction_variance[closure],
                self.noise.components,
            )
        return probability


def edge_variance(graph: ClosureGraph, noise: NoiseModel) -> np.ndarray:
    """Of every edge's own noise, if it is good, ``(E,)`` rad²."""
    return np.asarray(graph.steps * np.where(graph.is_odometry, noise.step_variance, noise.closure_variance))


def edge_weight(trust: np.ndarray, variance: np.ndarray) -> np.ndarray:
    """Trust of every edge in [0, 1] over its variance, ``(E,)``; enough at least for the system to be solvable."""
    return np.asarray(np.maximum(trust, _MIN_TRUST) / variance)
