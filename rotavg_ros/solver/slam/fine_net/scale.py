"""Rescales the noise of odometry and of closures when variances of single edges change, so that σ keeps its meaning.

If all others predict edges of variance v as N(μ, p), the likeliest common factor e^y of v satisfies, but for the prior
on σ,

    Σ ‖μ‖² v / (v + p)² = k Σ v / (v + p)

which is how the posterior estimates its noise (MacKay 1992). Because of the prior and of tails, the two sides differ
before the change; their difference is kept.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

_ROUNDS = 4
# Largest change of the logarithm in one Newton step.
_LONGEST = 1.5


@dataclass(frozen=True)
class Told:
    """Evidence on the noise of E edges (float64).

    Attributes:
        is_odometry: ``(E,)`` bool.
        good: ``(E,)`` 1 for good edges, else 0.
        square, predicted: ``(E,)`` rad², ‖μ‖² and p.
        components: k.
        noise_spread: prior standard deviation of the logarithm of each kind's σ.
    """

    is_odometry: Tensor
    good: Tensor
    square: Tensor
    predicted: Tensor
    components: int
    noise_spread: float

    def log_scale(self, before: Tensor, after: Tensor) -> Tensor:
        """``(2,)`` y of closures and of odometry, if variances change from ``before`` ``(E,)`` rad² to ``after``."""
        scale = after.new_zeros(2)
        prior = 1 / (2 * self.noise_spread) ** 2
        squares, freedom = self._sums(before)
        offset = squares - freedom
        for _ in range(_ROUNDS):
            squares, freedom = self._sums(after * scale.exp()[self.is_odometry.long()])
            slope = (squares - freedom - offset) / 2 - prior * scale
            scale = scale + (slope / ((squares + freedom) / 4 + prior)).clamp(-_LONGEST, _LONGEST)
        return scale

    def _sums(self, variance: Tensor) -> tuple[Tensor, Tensor]:
        """``(2,)`` each: sum of squares and degrees of freedom, of closures and of odometry."""
        part = self.good * variance / (variance + self.predicted)
        squares = part * self.square / (variance + self.predicted)
        kind = self.is_odometry.long()
        none = variance.new_zeros(2)
        return none.index_add(0, kind, squares), self.components * none.index_add(0, kind, part)
