"""How far the precisions that loop closures state are believed: exactly as far as their residuals bear them out.

The scale of what a front end states is often nonsense, and its differences from closure to closure may be, too. So of a
good closure's variance it is assumed that

    variance = σ_c² · (stated / typical) ^ α,        0 ≤ α ≤ 1,

with σ_c² and α from the likelihood of what is left of each closure if the rest of the graph predicts it. Unless that
speaks for it, α is 0 and all closures are alike.
"""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.judging import TAIL_RATIO, TAIL_SHARE
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.noise.model import NoiseModel

# A variance that is stated to be farther from what is typical than by this factor says nothing.
_MAX_RATIO = 100.0
# No closure is believed to be more than twice as exact as is typical: one that overstates its precision bends the map,
# one that understates it is hardly missed.
_MIN_RATIO = 0.25
# What closures state is worth nothing beforehand with this probability; else all exponents are as likely.
_WORTHLESS = 0.95
_EXPONENTS = np.linspace(0.0, 1.0, 5)
# A mean exponent below this is hardly more than what was known beforehand.
_MIN_EXPONENT = 0.1
# Where the logarithms of stated variances spread by less than this, weights could gain 4 % of variance at most.
_MIN_SPREAD = 0.2
# The likeliest scale is approached by these steps, of its logarithm.
_SCALE_STEPS = (1.0, 0.5, 0.2, 0.1)
# More closures than this say no more of one number.
_MAX_CLOSURES = 1000


class StatedTrust(NamedTuple):
    """How far stated variances are believed.

    Attributes:
        exponent: α.
        typical: stated variance, rad², of a closure whose own is σ_c².
    """

    exponent: float
    typical: float

    def relative_variance(self, stated: np.ndarray) -> np.ndarray:
        """Of closures in units of σ_c² ``(C,)`` by what they state, rad²; 1 where that is NaN or absurd."""
        ratio = stated / self.typical
        is_absurd = ~((ratio >= 1 / _MAX_RATIO) & (ratio <= _MAX_RATIO))
        return np.where(is_absurd, 1.0, np.maximum(ratio, _MIN_RATIO)) ** self.exponent


NO_TRUST = StatedTrust(0.0, 1.0)


def believing(graph: ClosureGraph, trust: StatedTrust) -> ClosureGraph:
    """The graph whose closures' own variances, and those by which they weigh, are as they state."""
    own_steps = graph.own_steps.copy()
    own_steps[graph.is_closure] = trust.relative_variance(graph.stated_variance[graph.is_closure])
    return replace(graph, own_steps=own_steps, steps=own_steps)


def estimate_trust(
    noise: NoiseModel,
    stated: np.ndarray,
    inlier_probability: np.ndarray,
    square: np.ndarray,
    prediction_variance: np.ndarray,
    worth: np.ndarray,
) -> StatedTrust:
    """The mean exponent over its posterior, with the scale that is likeliest with each. ``(C,)`` each.

    Args:
        noise: as it looks if all closures are alike.
        stated: rad², NaN where unknown.
        inlier_probability: that a closure is not a false one.
        square: rad², of the leave-one-out discrepancies.
        prediction_variance: rad², of what the rest of the graph predicts.
        worth: how many independent observations each closure is.
    """
    is_known = np.isfinite(stated) & (inlier_probability > 0.5)
    if not is_known.any():
        return NO_TRUST
    typical = float(np.exp(np.median(np.log(stated[is_known]))))
    if np.log(StatedTrust(1.0, typical).relative_variance(stated[is_known])).std() < _MIN_SPREAD:
        return NO_TRUST
    chosen = slice(None, None, max(1, len(stated) // _MAX_CLOSURES))
    relative = np.stack([StatedTrust(exponent, typical).relative_variance(stated[chosen]) for exponent in _EXPONENTS])
    likelihood = _Likelihood(noise, square[chosen], prediction_variance[chosen], worth[chosen])
    gain = likelihood.best_of_scales(noise.closure_variance * relative)
    prior = np.append(_WORTHLESS, np.full(len(gain) - 1, (1 - _WORTHLESS) / (len(gain) - 1)))
    posterior = prior * np.exp(gain - gain.max())
    exponent = float(_EXPONENTS @ posterior / posterior.sum())
    return StatedTrust(exponent, typical) if exponent > _MIN_EXPONENT else NO_TRUST


class _Likelihood:
    """Of the leave-one-out discrepancies of C closures: good, among the worse of the good ones, or false."""

    def __init__(
        self, noise: NoiseModel, square: np.ndarray, prediction_variance: np.ndarray, worth: np.ndarray
    ) -> None:
        """See :func:`estimate_trust`."""
        self._half_power, self._half_square = noise.components / 2, square / 2
        self._prediction_variance, self._worth = prediction_variance, worth
        uniform = log_uniform_density(np.sqrt(square), noise.components)
        self._false = uniform + self._half_power * np.log(2 * np.pi) - noise.prior_log_odds

    def best_of_scales(self, variance: np.ndarray) -> np.ndarray:
        """Largest logarithms ``(A,)``, but for a constant, over all factors on the closures' variances ``(A, C)``."""
        log_scale = np.zeros(len(variance))
        for step in _SCALE_STEPS:
            tried = np.exp(log_scale[:, None] + step * np.array([-1.0, 0.0, 1.0]))
            below, at, above = self._log(tried[:, :, None] * variance[:, None]).T
            # A parabola through the three; where it has no top, uphill.
            slope, curvature = (above - below) / 2, np.minimum(above - 2 * at + below, -1e-9)
            log_scale += step * np.clip(-slope / curvature, -2.0, 2.0)
        return np.asarray(at - slope**2 / (2 * curvature))

    def _log(self, variance: np.ndarray) -> np.ndarray:
        """``(…, C)`` → ``(…)``."""
        exact = self._log_odds(variance + self._prediction_variance) + np.log1p(-TAIL_SHARE)
        inexact = self._log_odds(TAIL_RATIO * variance + self._prediction_variance) + np.log(TAIL_SHARE)
        return np.asarray(np.log1p(np.exp(exact) + np.exp(inexact)) @ self._worth)

    def _log_odds(self, variance: np.ndarray) -> np.ndarray:
        """Of being good with this variance against being false."""
        return np.asarray(-self._half_square / variance - self._half_power * np.log(variance) - self._false)
