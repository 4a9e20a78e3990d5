"""Robust refinement of a SLAM graph: Gauss–Newton on the closure graph, every closure judged by all the others.

One pass solves one sparse system. It gives the corrections, and from a few more right-hand sides the effective
resistance of every edge, that is the variance of the difference of its ends. With it each closure is judged by what
the rest of the graph predicts of it (leave-one-out), which a long chain with one closure on it forgives and a dense
neighbourhood does not, and both noise variances are re-estimated by their redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.special import expit
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.agreement import AgreementPairs
from rotavg_ros.solver.closure_graph import ClosureGraph
from rotavg_ros.solver.common_error import closure_runs, common_share, variance_factor
from rotavg_ros.solver.exceedance import exceedance
from rotavg_ros.solver.laplacian import FactorisedLaplacian, LaplacianPattern, probe_signs
from rotavg_ros.solver.noise_model import NoiseModel, outlier_share
from rotavg_ros.solver.residuals import log_rows, multiply_rows

MAX_PASSES = 30
# From the answer of a graph that has hardly changed since: on a real robot's graph, tick by tick, as good as 30.
WARM_PASSES = 10
# A loop closure whose true noise exceeds this is an outlier.
OUTLIER_ANGLE = np.radians(10.0)
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
# Of a graph that has grown by a few edges: passes at most, and when they end; the next update goes on from there.
_UPDATE_PASSES = 5
_UPDATED_STEP = np.radians(0.02)
_UPDATED_PROBABILITY = 0.02
# After an update's first pass a probability that would change by more than this goes half the way.
_SWING = 0.2
# A graph that turns by more than this is solved as a whole.
_MAX_UPDATE = np.radians(20.0)
# An edge that alone holds two parts of the graph together has leverage 1; it cannot be judged by the others.
_MAX_LEVERAGE = 0.999
# Redundancy below this many edges' worth says little about a variance; the estimate so far is worth as much.
_PRIOR_ODOMETRY_REDUNDANCY = 5.0
_PRIOR_CLOSURE_SQUARE = np.radians(0.08) ** 2
# Errors that closures share look like odometry noise in the fit. How odometry drifts over long ways tells otherwise, so
# the fit may raise that estimate by this factor at most, and not at all once closures are seen to err together.
_MAX_STEP_VARIANCE_GAIN = 1.5
_MIN_COMMON_SHARE = 0.06
# This share of the good closures errs more than the others, and of what the rest predicts of them, by so many times the
# variance; less where that would look like a false one. Else a closure that alone ties a long loop is called false for
# an error of a degree, or for odometry that did not drift evenly.
_TAIL_SHARE = 0.1
_TAIL_RATIO = 16.0
_MAX_TAIL_VARIANCE = np.radians(1.5) ** 2
_MAX_PREDICTED_TAIL_VARIANCE = np.radians(3.0) ** 2
# In larger graphs the likeliest drift is near what is believed.
_MAX_NODES_TO_DRAW_AGAIN = 2000


@dataclass(frozen=True)
class SlamEstimate:
    """The refined closure graph (K key nodes, E edges).

    Attributes:
        correction: ``(K, 4)`` C.
        inlier_probability: ``(E,)`` that an edge is not a false one, which is what it weighs.
        outlier_probability: ``(E,)`` that its true noise exceeds :data:`OUTLIER_ANGLE`, or that a segment slipped.
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


def refine(
    graph: ClosureGraph,
    pairs: AgreementPairs,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    *,
    log_odds: np.ndarray | None = None,
    max_passes: int = MAX_PASSES,
    hold_noise: bool = False,
) -> SlamEstimate:
    """Alternate solving and judging until neither moves; once more if neighbouring closures err together.

    Args:
        pairs: the graph's neighbouring closures.
        correction: ``(K, 4)`` start; identities for the odometry itself.
        inlier_probability: ``(E,)`` start; that of odometry is kept.
        noise: start.
        log_odds: ``(E,)`` prior log-odds of each edge to be good, beyond the common outlier share; ±inf decide it.
        max_passes: sparse solves at most, at least 1.
        hold_noise: keep both variances as given.
    """
    prior = np.zeros(len(graph.source)) if log_odds is None else log_odds
    state = _State(graph, correction, inlier_probability, noise, prior, hold_noise)
    max_step_variance = _MAX_STEP_VARIANCE_GAIN * noise.step_variance
    state.alternate(max_step_variance, (max_passes + 1) // 2)
    share = 0.0
    closure = np.flatnonzero(graph.is_closure)
    if len(pairs.first) and state.passes < max_passes:
        good = state.inlier_probability[closure]
        older_end = np.minimum(graph.position[graph.source], graph.position[graph.target])[closure]
        run = closure_runs(pairs, good > 0.5, older_end)
        # Closures run old → new and new → old; their errors compare in one direction only.
        direction = np.where(graph.position[graph.source] < graph.position[graph.target], 1.0, -1.0)[closure, None]
        residual, samples = direction * state.residual[closure], direction * state.difference(state.samples)[closure]
        share = common_share(run, good, residual, samples, state.noise.closure_variance, noise.components)
        if share > _MIN_COMMON_SHARE:
            steps = graph.steps.copy()
            steps[closure] *= variance_factor(run, good, share)
            state.graph = replace(graph, steps=steps)
            state.noise = replace(state.noise, step_variance=min(noise.step_variance, state.noise.step_variance))
            max_step_variance = noise.step_variance
            state.alternate(max_step_variance, max_passes)
    return state.estimate(share, max_step_variance)


def update(
    graph: ClosureGraph,
    correction: Tensor,
    inlier_probability: np.ndarray,
    noise: NoiseModel,
    log_odds: np.ndarray,
    max_step_variance: float,
    rank: np.ndarray,
    exact_share: np.ndarray,
) -> SlamEstimate | None:
    """The same for a graph that has grown a little since :func:`refine`, from the verdicts and noise it ended with.

    Args:
        graph: with steps as :class:`SlamEstimate` has them.
        max_step_variance: as :class:`SlamEstimate` has it.
        rank: ``(K,)`` order of elimination.
        exact_share: as :class:`SlamEstimate` has it.

    Returns:
        None if orientations turn by so much that all has to be judged anew.
    """
    state = _State(graph, correction, inlier_probability, noise, log_odds, False, rank)
    state.is_update = True
    state.exact_share = exact_share
    state.exactness = exact_share + (1 - exact_share) / _tail_ratio(noise.closure_variance)
    for _ in range(_UPDATE_PASSES):
        moved, changed = state.one_pass(max_step_variance, refresh=not state.has_predictions)
        if moved > _MAX_UPDATE:
            return None
        if moved < _UPDATED_STEP and changed < _UPDATED_PROBABILITY:
            break
    return state.estimate(0.0, max_step_variance) if state.has_predictions else None


class _State:
    """The unknowns, and what the last pass saw of them."""

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
            step_variance = min(max_step_variance, _step_variance(square_per_step, redundancy[odometry], noise))
            exact = self.exact_share[closure]
            closure_variance = _closure_variance(
                square[closure], self.inlier_probability[closure] * exact, redundancy[closure] * exact, noise
            )
        share = outlier_share(self.inlier_probability[closure])
        self.noise = replace(noise, step_variance=step_variance, closure_variance=closure_variance, outlier_share=share)

        # What is left of the fit without the edge itself, and how far that may be off.
        predicted_square = np.minimum(square / (1 - leverage) ** 2, np.pi**2)
        scale = np.where(odometry, 1.0, self.noise.closure_variance / noise.closure_variance)
        predicted_variance = scale * variance + self.prediction_variance
        judged = self.noise.inlier_log_odds(predicted_square, predicted_variance)
        tail = _tail_ratio(self.noise.closure_variance)
        if tail > 1:
            bound = np.maximum(_MAX_PREDICTED_TAIL_VARIANCE, self.prediction_variance)
            tail_variance = tail * scale * variance + np.minimum(tail * self.prediction_variance, bound)
            exact = judged + np.log1p(-_TAIL_SHARE)
            inexact = self.noise.inlier_log_odds(predicted_square, tail_variance) + np.log(_TAIL_SHARE)
            judged = np.logaddexp(exact, inexact)
            self.exact_share = np.where(closure, expit(exact - inexact), 1.0)
            self.exactness = self.exact_share + (1 - self.exact_share) / tail
        judged = judged + self.noise.prior_log_odds
        probability = np.where(closure, expit(judged + self.prior_log_odds), self.inlier_probability)
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
        """That a closure's true noise exceeds :data:`OUTLIER_ANGLE`, or that a segment slipped, ``(E,)``.

        A discrepancy is a closure's noise and the prediction's error. Noise of a good closure is known beforehand to be
        Gaussian; a false one's can be anything, so that the discrepancy alone says what it is.
        """
        noise, good = self.noise, self.inlier_probability
        if self._discrepancy is None:
            return np.asarray(1 - good)
        own = noise.closure_variance / (noise.closure_variance + self.prediction_variance)
        narrowed = own * self._discrepancy, own * self.prediction_variance
        if_good = exceedance(*narrowed, OUTLIER_ANGLE, noise.components)
        if_false = exceedance(self._discrepancy, self.prediction_variance, OUTLIER_ANGLE, noise.components)
        wrong = good * if_good + (1 - good) * if_false
        return np.asarray(np.where(self.graph.is_closure, wrong, 1 - good))


def _tail_ratio(closure_variance: float) -> float:
    """By how much larger the variance of the worse ones among good closures is."""
    return float(np.clip(_MAX_TAIL_VARIANCE / closure_variance, 1.0, _TAIL_RATIO))


def _step_variance(square: np.ndarray, redundancy: np.ndarray, noise: NoiseModel) -> float:
    prior = _PRIOR_ODOMETRY_REDUNDANCY * noise.components
    total = float(square.sum()) + prior * noise.step_variance
    return float(total / (float(redundancy.sum()) * noise.components + prior))


def _closure_variance(square: np.ndarray, probability: np.ndarray, redundancy: np.ndarray, noise: NoiseModel) -> float:
    total = float((probability * square).sum()) + _PRIOR_CLOSURE_SQUARE
    return float(total / (float(redundancy.sum()) * noise.components + 1))
