"""By how much both kinds' noise changes when variances of single edges do, so that σ goes on to mean what it does.

Of edges of variance v, of which all others say N(μ, p), the likeliest common factor e^y of v makes

    Σ ‖μ‖² v / (v + p)² = k Σ v / (v + p)

but for the prior on σ: the redundancy that residuals leave, as the posterior estimates its noise (MacKay 1992). What
was left of that equation before, by the prior and by tails, is left of it after.
"""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor

_ROUNDS = 4
# A Newton step changes the logarithm by no more.
_LONGEST = 1.5


@dataclass(frozen=True)
class Told:
    """What others say of E edges' noise (float64).

    Attributes:
        is_odometry: ``(E,)`` bool.
        good: ``(E,)`` 1 for good edges, else 0.
        square, predicted: ``(E,)`` rad², ‖μ‖² and p.
        components: k.
        noise_spread: standard deviation of the logarithm of either kind's σ, beforehand.
    """

    is_odometry: Tensor
    good: Tensor
    square: Tensor
    predicted: Tensor
    components: int
    noise_spread: float

    def log_scale(self, before: Tensor, after: Tensor) -> Tensor:
        """``(2,)`` of the variances of closures and of odometry, when ``before`` ``(E,)`` rad² becomes ``after``."""
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
        """``(2,)`` squares and degrees of freedom of either kind."""
        part = self.good * variance / (variance + self.predicted)
        squares = part * self.square / (variance + self.predicted)
        kind = self.is_odometry.long()
        none = variance.new_zeros(2)
        return none.index_add(0, kind, squares), self.components * none.index_add(0, kind, part)
