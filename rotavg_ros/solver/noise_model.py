"""The noise of a SLAM graph: Gaussian odometry steps and closures, and closures that are wrong altogether.

An inlier's discrepancy with another estimate is Gaussian in k components (k = 1 where all rotations share an axis, else
3); a false closure is uniform over all rotations. Stated precisions are often nonsense, so both variances are
estimated: at first by expectation–maximisation over the closures' discrepancies against odometry, which grow with
the number of steps passed while the closures' own noise does not, and later from fitted residuals and their redundancy.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.special import expit

# Priors, each worth one observation: they only matter where data are too few to tell.
_PRIOR_STEP_VARIANCE = np.radians(0.1) ** 2
_PRIOR_CLOSURE_VARIANCE = np.radians(1.0) ** 2
_PRIOR_OUTLIER_COUNTS = (1.0, 3.0)
_EM_STARTS_STEP_DEG = (0.02, 0.1, 0.5, 2.0)
_EM_ITERATIONS = 100
_EM_TOLERANCE = 1e-4


@dataclass(frozen=True)
class NoiseModel:
    """Variances are of one component of the rotation vector, in rad².

    Attributes:
        components: k, 1 for planar motion, else 3.
        step_variance: of one odometry edge.
        closure_variance: of a good loop closure.
        outlier_share: share of the closures that are false.
    """

    components: int
    step_variance: float
    closure_variance: float
    outlier_share: float

    def inlier_log_odds(self, squared_angle: np.ndarray, variance: np.ndarray) -> np.ndarray:
        """Log-odds of good against false, without the prior, for discrepancies of given total variance.

        Args:
            squared_angle: ``(E,)`` rad².
            variance: ``(E,)`` rad² per component.
        """
        gaussian = -squared_angle / (2 * variance) - self.components / 2 * np.log(2 * np.pi * variance)
        return gaussian - log_uniform_density(np.sqrt(squared_angle), self.components)

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
    return np.log(half * half / (8 * np.pi**2))


def outlier_share(inlier_probability: np.ndarray) -> float:
    """Share of false closures, kept off 0 and 1 by a prior of a few counts."""
    false_count, total_count = _PRIOR_OUTLIER_COUNTS[0], sum(_PRIOR_OUTLIER_COUNTS)
    return float(((1 - inlier_probability).sum() + false_count) / (len(inlier_probability) + total_count))


def estimate_noise(
    squared_angle: np.ndarray, path_steps: np.ndarray, components: int, closure_prior_log_odds: np.ndarray | None = None
) -> tuple[NoiseModel, np.ndarray]:
    """Two variances and an outlier share from closures alone, by EM from several starts; the likeliest is kept.

    Args:
        squared_angle: ``(C,)`` rad², discrepancy of each closure against odometry.
        path_steps: ``(C,)`` odometry steps that the discrepancy passes, at least 1; closures with inf are left out.
        closure_prior_log_odds: ``(C,)`` what is known of each closure beforehand, added to the common prior.

    Returns:
        The model and the probability ``(C,)`` of each closure to be good.
    """
    usable = np.isfinite(path_steps)
    angle2, steps = squared_angle[usable], np.maximum(path_steps[usable], 1.0)
    extra = np.zeros(len(angle2)) if closure_prior_log_odds is None else closure_prior_log_odds[usable]
    best_likelihood, best = -np.inf, None
    for start_deg in _EM_STARTS_STEP_DEG:
        model = NoiseModel(components, np.radians(start_deg) ** 2, _PRIOR_CLOSURE_VARIANCE, 0.3)
        likelihood = -np.inf
        for _ in range(_EM_ITERATIONS):
            variance = steps * model.step_variance + model.closure_variance
            log_odds = model.inlier_log_odds(angle2, variance) + model.prior_log_odds + extra
            good = expit(log_odds)
            previous, likelihood = likelihood, float(np.logaddexp(0, log_odds).sum() + _log_false(model, angle2).sum())
            if likelihood - previous < _EM_TOLERANCE:
                break
            # Expected squares of the two parts of each discrepancy, given their sum.
            from_steps = steps * model.step_variance / variance
            step_square = from_steps**2 * angle2 + components * steps * model.step_variance * (1 - from_steps)
            closure_square = (1 - from_steps) ** 2 * angle2 + components * model.closure_variance * from_steps
            observations = components * good.sum() + 1
            model = NoiseModel(
                components,
                float((good * step_square / steps).sum() + _PRIOR_STEP_VARIANCE) / observations,
                float((good * closure_square).sum() + _PRIOR_CLOSURE_VARIANCE) / observations,
                outlier_share(good),
            )
        if best is None or likelihood > best_likelihood:
            best_likelihood, best = likelihood, model
    assert best is not None
    variance = np.where(usable, np.maximum(path_steps, 1.0), 0.0) * best.step_variance + best.closure_variance
    log_odds = best.inlier_log_odds(squared_angle, variance) + best.prior_log_odds
    if closure_prior_log_odds is not None:
        log_odds = log_odds + closure_prior_log_odds
    return best, np.where(usable, expit(log_odds), expit(best.prior_log_odds))


def _log_false(model: NoiseModel, squared_angle: np.ndarray) -> np.ndarray:
    return log_uniform_density(np.sqrt(squared_angle), model.components) + np.log(model.outlier_share)
