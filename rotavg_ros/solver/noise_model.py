"""The noise of a SLAM graph: Gaussian odometry steps and closures, and closures that are wrong altogether.

An inlier's discrepancy with another estimate is Gaussian in k components (k = 1 where all rotations share an axis, else
3); a false closure is uniform over all rotations. Stated precisions are often nonsense, so both variances are
estimated: at first by expectation–maximisation over the closures' discrepancies against odometry, which grow with
the number of steps passed while the closures' own noise does not, and later from fitted residuals and their redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.solver.agreement import AgreementPairs

# What is assumed where there is nothing to estimate from.
_PRIOR_STEP_VARIANCE = np.radians(0.3) ** 2
_PRIOR_CLOSURE_VARIANCE = np.radians(2.0) ** 2
# One pseudo-observation each, in rad²: they keep variances off zero.
_PRIOR_STEP_SQUARE = np.radians(0.02) ** 2
_PRIOR_CLOSURE_SQUARE = np.radians(0.3) ** 2
_PRIOR_OUTLIER_COUNTS = (1.0, 3.0)
# Neighbours tell the noise of good closures, but not how many are false.
_NEIGHBOURS_OUTLIER_SHARE = 0.3
_EM_STARTS_STEP_DEG = (0.02, 0.1, 0.5, 2.0)
_EM_STARTS_CLOSURE_DEG = (0.3, 2.0)
# Rows of either kind used to choose among the starts, and to converge.
_EM_THINNED = (1000, 5000)
# Of the starts, so many are kept after so many iterations each.
_EM_ROUNDS = ((3, 4), (1, 8))
_EM_ITERATIONS = 60
_EM_TOLERANCE = 1e-3
# The likelihood hardly knows a small graph's drift, and closures that err in the tails look like drift. Of all step
# variances that are less likely by no more than this, down to a share of the likeliest, the least is taken: odometry
# that is trusted too far costs a few good closures until more of them come, a false closure believed bends the map.
_STEP_DOUBT = 5.0
_STEP_DOUBT_SHARES = np.array([0.85, 0.7, 0.55, 0.47, 0.4]) ** 2
_DOUBT_ITERATIONS = 8


@dataclass(frozen=True)
class NoiseModel:
    """Variances are of one component of the rotation vector, in rad².

    Attributes:
        components: k, 1 for planar motion, else 3.
        step_variance: of one odometry edge.
        closure_variance: of a good loop closure.
        outlier_share: share of the closures that are false.
        likely_step_variance: the likeliest, where ``step_variance`` is kept low; what uncertainty is stated by.
    """

    components: int
    step_variance: float
    closure_variance: float
    outlier_share: float
    likely_step_variance: float = 0.0

    def inlier_log_odds(self, squared_angle: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Log-odds of good against false, without the prior, for discrepancies of given total variance.

        Args:
            squared_angle: ``(E,)`` rad².
            variance: ``(E,)`` rad² per component.
        """
        gaussian = -squared_angle / (2 * variance) - self.components / 2 * np.log(2 * np.pi * variance)
        return np.asarray(gaussian - log_uniform_density(np.sqrt(squared_angle), self.components))

    @property
    def prior_log_odds(self) -> float:
        """Log-odds of good against false before anything is measured."""
        return float(np.log1p(-self.outlier_share) - np.log(self.outlier_share))


def log_uniform_density(angle: np.ndarray, components: int) -> np.ndarray:
    """Log density of the uniform distribution over rotations at a rotation vector of length ``angle`` (rad)."""
    if components == 1:
        return np.full(len(angle), -np.log(2 * np.pi))
    # Haar measure in rotation-vector coordinates: (1 − cos θ) / (4π² θ²).
    half = np.sinc(np.minimum(angle, np.pi) / (2 * np.pi))
    return np.asarray(np.log(half * half / (8 * np.pi**2)))


def outlier_share(inlier_probability: np.ndarray) -> float:
    """Share of false closures, kept off 0 and 1 by a prior of a few counts."""
    false_count, total_count = _PRIOR_OUTLIER_COUNTS[0], sum(_PRIOR_OUTLIER_COUNTS)
    return float(((1 - inlier_probability).sum() + false_count) / (len(inlier_probability) + total_count))


@dataclass(frozen=True)
class Discrepancies:
    """Differences that would be small if the closures in them were good.

    Attributes:
        squared_angle: ``(D,)`` rad².
        steps: ``(D,)`` odometry steps that each passes.
        closures: ``(D,)`` number of closures in each.
        weight: ``(D,)``.
        kind: ``(D,)`` 0 or 1; each kind has its own share of outliers.
    """

    squared_angle: np.ndarray
    steps: np.ndarray
    closures: np.ndarray
    weight: np.ndarray
    kind: np.ndarray

    def thinned(self, size: int) -> Discrepancies:
        """Evenly spread rows, about ``size`` of each kind, that weigh as much as all of them."""
        rows, factor = [], []
        for kind in (0, 1):
            members = np.flatnonzero(self.kind == kind)
            stride = max(1, len(members) // size)
            rows.append(members[::stride])
            factor.append(np.full(len(rows[-1]), stride))
        chosen = np.concatenate(rows)
        thinned = Discrepancies(*(getattr(self, name)[chosen] for name in self.__dataclass_fields__))
        return replace(thinned, weight=thinned.weight * np.concatenate(factor))


def discrepancies(squared_angle: np.ndarray, path_steps: np.ndarray, pairs: AgreementPairs) -> Discrepancies:
    """Of every closure with the odometry (``(C,)`` each; infinite steps tell nothing), and of agreeing closures."""
    on_chain = np.flatnonzero(np.isfinite(path_steps))
    num_chain, num_pairs = len(on_chain), len(pairs.first)
    per_closure = num_pairs / max(len(np.unique(pairs.first)), 1)
    return Discrepancies(
        np.concatenate((squared_angle[on_chain], pairs.squared_angle)),
        np.concatenate((np.maximum(path_steps[on_chain], 1.0), np.maximum(pairs.steps, 0.5))),
        np.concatenate((np.ones(num_chain), np.full(num_pairs, 2.0))),
        np.concatenate((np.ones(num_chain), np.full(num_pairs, 1 / max(per_closure, 1.0)))),
        np.concatenate((np.zeros(num_chain, dtype=np.int64), np.ones(num_pairs, dtype=np.int64))),
    )


def estimate_noise(data: Discrepancies, components: int) -> NoiseModel:
    """Two variances and an outlier share by expectation–maximisation from several starts; the likeliest is kept.

    Of the step variance, the lower end of what is nearly as likely.

    A discrepancy is Gaussian with variance ``steps · step_variance + closures · closure_variance`` or uniform. The
    closures' own agreement holds the estimate up where odometry has drifted past recognition or most closures are
    false; their discrepancy with the chain separates the two variances.
    """
    return _least_drift(data.thinned(_EM_THINNED[0]), _likeliest(data, components))


def _likeliest(data: Discrepancies, components: int) -> NoiseModel:
    if len(data.steps) == 0:
        return NoiseModel(components, _PRIOR_STEP_VARIANCE, _PRIOR_CLOSURE_VARIANCE, 0.25)
    few = data.thinned(_EM_THINNED[0])
    starts = [
        NoiseModel(components, np.radians(step) ** 2, np.radians(closure) ** 2, 0.5)
        for step in _EM_STARTS_STEP_DEG
        for closure in _EM_STARTS_CLOSURE_DEG
    ]
    for survivors, iterations in _EM_ROUNDS:
        grown = sorted((_maximise(few, start, iterations) for start in starts), key=lambda one: -one[0])
        starts = [model for _, model in grown[:survivors]]
    best = starts[0]
    return _maximise(data.thinned(_EM_THINNED[1]), best, _EM_ITERATIONS)[1]


def noise_between_neighbours(pairs: AgreementPairs, components: int) -> NoiseModel:
    """The noise as neighbouring closures see it: without the odometry that lies farther between, so immune to slips."""
    nothing = np.empty(0)
    model = _likeliest(discrepancies(nothing, nothing, pairs), components)
    # Where few closures share their ends, odometry takes their noise for its own; but none is better than a step.
    closure_variance = max(model.closure_variance, model.step_variance)
    return replace(model, closure_variance=closure_variance, outlier_share=_NEIGHBOURS_OUTLIER_SHARE)


def _least_drift(data: Discrepancies, likeliest: NoiseModel) -> NoiseModel:
    """The model of least step variance that is nearly as likely as the likeliest."""
    if len(data.steps) == 0:
        return likeliest
    profile = [_maximise(data, likeliest, _DOUBT_ITERATIONS, hold_step=True)]
    for share in _STEP_DOUBT_SHARES:
        start = replace(profile[-1][1], step_variance=share * likeliest.step_variance)
        profile.append(_maximise(data, start, _DOUBT_ITERATIONS, hold_step=True))
    bar = max(likelihood for likelihood, _ in profile) - _STEP_DOUBT
    least = [model for likelihood, model in profile if likelihood >= bar][-1]
    least = likeliest if least is profile[0][1] else least
    return replace(least, likely_step_variance=likeliest.step_variance)


def _maximise(
    data: Discrepancies, model: NoiseModel, iterations: int, *, hold_step: bool = False
) -> tuple[float, NoiseModel]:
    """EM from ``model``, on request with its step variance; returns the log-likelihood and the last model."""
    k, squared_angle = model.components, data.squared_angle
    uniform = log_uniform_density(np.sqrt(squared_angle), k)
    density_of_false = uniform + k / 2 * np.log(2 * np.pi)
    square_per_step, square_per_closure = squared_angle / data.steps, squared_angle / data.closures
    total = np.bincount(data.kind, data.weight, 2)
    shares = np.array([model.outlier_share, 0.7])
    likelihood = -np.inf
    for _ in range(iterations):
        from_steps = data.steps * model.step_variance
        variance = from_steps + data.closures * model.closure_variance
        # The arithmetic of NoiseModel.inlier_log_odds, expit and logaddexp with one logarithm and one exponential each.
        log_share = np.log(shares)
        prior = (np.log1p(-shares) - log_share)[data.kind]
        log_odds = prior - squared_angle / (2 * variance) - k / 2 * np.log(variance) - density_of_false
        rest = np.exp(-np.abs(log_odds))
        surprise = np.maximum(log_odds, 0) + np.log1p(rest) + log_share[data.kind] + uniform
        previous, likelihood = likelihood, float(data.weight @ surprise)
        if likelihood - previous < _EM_TOLERANCE:
            break
        good = data.weight * np.where(log_odds > 0, 1.0, rest) / (1 + rest)
        # Expected squares of the two parts of each discrepancy, given their sum.
        part = from_steps / variance
        kept = part * good
        rest_kept = good - kept
        step_square = kept @ (part * square_per_step) + k * model.step_variance * rest_kept.sum()
        closure_square = rest_kept @ ((1 - part) * square_per_closure) + k * model.closure_variance * kept.sum()
        observations = k * good.sum() + 1
        bad = total - np.bincount(data.kind, good, 2)
        shares = np.clip((bad + 1) / (total + 2), 0.005, 0.995)
        step_variance = float(step_square + _PRIOR_STEP_SQUARE) / observations
        model = NoiseModel(
            k,
            model.step_variance if hold_step else step_variance,
            float(closure_square + _PRIOR_CLOSURE_SQUARE) / observations,
            float(shares[0]),
        )
    return likelihood, model


def judge_by_chain(model: NoiseModel, squared_angle: np.ndarray, path_steps: np.ndarray) -> np.ndarray:
    """Log-odds of each closure to be good from its discrepancy with the odometry alone, without a prior."""
    finite = np.isfinite(path_steps)
    variance = np.where(finite, path_steps, 0.0) * model.step_variance + model.closure_variance
    return np.where(finite, model.inlier_log_odds(squared_angle, variance), 0.0)
