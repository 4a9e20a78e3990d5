"""Expectation–maximisation for rotations that differ by two kinds of noise, or by an arbitrary rotation.

A discrepancy between two estimates is Gaussian in k components with variance ``steps · step_variance + closures ·
closure_variance``, or one of them is false and it is uniform over all rotations (or, as a near miss, over those by a
small angle). The maximisation step treats each discrepancy as the sum of its two parts, of which only the sum is
observed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

# One pseudo-observation each, rad²: they keep variances away from zero.
_PRIOR_STEP_SQUARE = np.radians(0.02) ** 2
_PRIOR_CLOSURE_SQUARE = np.radians(0.3) ** 2
_SHARE_BOUNDS = (0.005, 0.995)
# Smaller rotations, rad, are near misses: places that look alike are often nearly the same.
NEAR_MISS = np.radians(35.0)
# Smaller gains of the log-likelihood do not count, nats.
_TOLERANCE = 0.01


@dataclass(frozen=True)
class Discrepancies:
    """D differences of one kind, which would be small if the closures in them were good.

    Attributes:
        squared_angle: ``(D,)`` rad².
        steps: ``(D,)`` odometry steps that each passes.
        closures: number of closures in each.
        weight: weight of each.
        near_share: share of the false ones that are near misses (:data:`NEAR_MISS`).
    """

    squared_angle: np.ndarray
    steps: np.ndarray
    closures: int
    weight: float
    near_share: float = 0.0

    def thinned(self, size: int) -> Discrepancies:
        """About ``size`` evenly spread rows that weigh as much as all of them."""
        stride = max(1, len(self.steps) // size)
        rows = slice(None, None, stride)
        return replace(
            self, squared_angle=self.squared_angle[rows], steps=self.steps[rows], weight=stride * self.weight
        )

    def log_false_density(self, components: int) -> np.ndarray:
        """Log density of each if it is false: uniform over all rotations, or over the near ones."""
        angle = np.sqrt(self.squared_angle)
        all_of_them = np.pi if components == 1 else np.pi / (1 - np.sinc(NEAR_MISS / np.pi))
        denser = np.where(angle < NEAR_MISS, 1 + self.near_share * (all_of_them / NEAR_MISS - 1), 1 - self.near_share)
        return np.asarray(log_uniform_density(angle, components) + np.log(denser))


def log_uniform_density(angle: np.ndarray, components: int) -> np.ndarray:
    """Log density of the uniform distribution over rotations at a rotation vector of length ``angle`` (rad)."""
    if components == 1:
        return np.full(len(angle), -np.log(2 * np.pi))
    # Haar measure in rotation-vector coordinates: (1 − cos θ) / (4π² θ²).
    half = np.sinc(np.minimum(angle, np.pi) / (2 * np.pi))
    return np.asarray(np.log(half * half / (8 * np.pi**2)))


class Mixtures(NamedTuple):
    """S models side by side.

    Attributes:
        step_variance, closure_variance: ``(S,)`` rad² per component.
        false_share: ``(S, kinds)`` share of each kind's discrepancies that are false.
    """

    step_variance: np.ndarray
    closure_variance: np.ndarray
    false_share: np.ndarray

    def best(self, log_likelihood: np.ndarray, count: int) -> Mixtures:
        """The ``count`` likeliest, given the log-likelihoods ``(S,)``, the likeliest first."""
        chosen = np.argsort(-log_likelihood, kind="stable")[:count]
        return Mixtures(*(values[chosen] for values in self))


class MixtureFit:
    """Models of discrepancies of several kinds, each kind with its own share of false ones.

    Args:
        kinds: the discrepancies.
        components: k.
    """

    def __init__(self, kinds: Sequence[Discrepancies], components: int) -> None:
        self._k = components
        # Exponentials and logarithms take a fifth of the time in single precision.
        squared_angle = np.concatenate([kind.squared_angle for kind in kinds], dtype=np.float32)
        log_false = np.concatenate([kind.log_false_density(components) for kind in kinds], dtype=np.float32)
        self._half_square = squared_angle / 2
        self._steps = np.concatenate([kind.steps for kind in kinds], dtype=np.float32)
        self._false = log_false + np.float32(components / 2 * np.log(2 * np.pi))
        size = [len(kind.steps) for kind in kinds]
        self._closures = np.repeat([kind.closures for kind in kinds], size).astype(np.float32)
        self._weight = np.repeat([kind.weight for kind in kinds], size)
        self._size = size
        # (D, kinds): sums over each kind are a single product.
        kind = np.repeat(np.arange(len(kinds)), size)
        self._membership = (np.eye(len(kinds))[kind] * self._weight[:, None]).astype(np.float32)
        self._total = np.array([kind.weight * len(kind.steps) for kind in kinds])
        self._constant = float(self._weight @ log_false)

    @property
    def log_likelihood_if_false(self) -> float:
        """Log-likelihood of the discrepancies if all of them are false."""
        return self._constant

    def maximise(self, models: Mixtures, iterations: int, *, hold_step: bool = False) -> tuple[Mixtures, np.ndarray]:
        """Iterate the models until none gains; returns also the log-likelihoods ``(S,)`` before the last iteration.

        Args:
            iterations: largest number.
            hold_step: keep the variance of a step.
        """
        last = np.full(len(models.step_variance), -np.inf)
        for _ in range(iterations):
            following, log_likelihood = self.step(models)
            models = following._replace(step_variance=models.step_variance) if hold_step else following
            if (log_likelihood - last).max() < _TOLERANCE:
                break
            last = log_likelihood
        return models, log_likelihood

    def converge(self, model: Mixtures, max_steps: int) -> Mixtures:
        """One model until its likelihood no longer grows, by squared extrapolation (Varadhan & Roland 2008).

        Two steps show how fast the steps shrink, and so where they would end.
        """
        last = -np.inf
        for _ in range(max_steps // 3):
            first, log_likelihood = self.step(model)
            if log_likelihood[0] - last < _TOLERANCE:
                return first
            last = float(log_likelihood[0])
            second, _ = self.step(first)
            at, once, twice = _coordinates(model), _coordinates(first), _coordinates(second)
            length, turn = once - at, twice - 2 * once + at
            factor = max(float(np.linalg.norm(length)) / max(float(np.linalg.norm(turn)), 1e-12), 1.0)
            ahead, log_likelihood = self.step(_mixtures(at + 2 * factor * length + factor**2 * turn))
            # Where the extrapolation overshoots, the result of the two steps is kept.
            model = ahead if log_likelihood[0] >= last else second
        return model

    def step(self, models: Mixtures) -> tuple[Mixtures, np.ndarray]:
        """One iteration of S models, and the log-likelihoods ``(S,)`` of those that were given."""
        k = self._k
        step_variance, closure_variance = (values[:, None].astype(np.float32) for values in models[:2])
        from_steps = step_variance * self._steps
        variance = closure_variance * self._closures
        variance += from_steps
        surprise = self._half_square / variance
        odds = np.repeat(np.log(1 / models.false_share - 1).astype(np.float32), self._size, axis=1)
        odds -= self._false
        odds -= surprise
        part = np.divide(from_steps, variance, out=from_steps)
        odds -= np.float32(k / 2) * np.log(variance, out=variance)
        np.exp(odds, out=odds)
        either = 1 + odds
        good = np.divide(odds, either, out=odds)
        log_likelihood = np.log(either, out=either) @ self._weight
        log_likelihood += self._constant + np.log(models.false_share) @ self._total
        # The steps' part of the good share; and expected squares of both parts, given their sum.
        values = np.empty((4, *good.shape), dtype=np.float32)
        values[0] = good
        np.multiply(part, good, out=values[1])
        np.multiply(values[:2], surprise, out=values[2:])
        sum_good, sum_steps, square, square_steps = (values @ self._membership).astype(np.float64)
        steps, squares, squares_of_steps = sum_steps.sum(axis=1), 2 * square.sum(axis=1), 2 * square_steps.sum(axis=1)
        all_good = sum_good.sum(axis=1)
        step_square = models.step_variance * (squares_of_steps + k * (all_good - steps))
        closure_square = models.closure_variance * (squares - squares_of_steps + k * steps)
        observations = k * all_good + 1
        maximised = Mixtures(
            (step_square + _PRIOR_STEP_SQUARE) / observations,
            (closure_square + _PRIOR_CLOSURE_SQUARE) / observations,
            np.clip((self._total - sum_good + 1) / (self._total + 2), *_SHARE_BOUNDS),
        )
        return maximised, log_likelihood


def _coordinates(model: Mixtures) -> np.ndarray:
    """One model as an unconstrained vector."""
    share = model.false_share[0]
    return np.concatenate((np.log(model.step_variance), np.log(model.closure_variance), np.log(share / (1 - share))))


def _mixtures(coordinates: np.ndarray) -> Mixtures:
    """The inverse of :func:`_coordinates`; variances are kept within reasonable bounds."""
    variances = np.exp(np.clip(coordinates[:2], -40.0, 5.0))
    share = np.clip(1 / (1 + np.exp(-coordinates[2:])), *_SHARE_BOUNDS)
    return Mixtures(variances[:1], variances[1:], share[None])
