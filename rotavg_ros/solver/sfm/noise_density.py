"""How heavy the noise's tails are: this selects the cost that the last steps lower.

The cost |r|^½ corresponds to noise of density exp(−(r/s)^½), with a sharp peak at zero and heavy tails, like real
measurements and the recipes'. Normal noise about three axes has exp(−(r/s)²), and |r|^½ costs it a fifth of its
accuracy. So each component uses the density of highest likelihood, with false edges uniform over rotations:

    p(r) = π c_β s⁻³ exp(−(r/s)^β) + (1 − π) / (8 π²),     β of ½, ¾, 1, 1½, 2,     c_β = β / (4π Γ(3/β)).

An edge then has weight w = P(good | r) β r^(β−2) / s^β, with which least-squares steps lead to the maximum (expectation
and maximisation). β stays ½, and nothing changes, unless another value is clearly likelier. It stays ½ as well where
good edges err less than the steps before resolve: such residuals say where these ended, and not how errors are spread.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from rotavg_ros.solver.sfm.priors import DensityPriors

# Floor of squared residuals, in units of the noise's shape, numerical.
_LEAST_SQUARE = 1e-12
# A false edge keeps this share of the weight of an edge whose residual equals the scale, so its ends stay attached.
_LEAST_WEIGHT = 1e-6


@dataclass(frozen=True)
class NoiseDensity:
    """Density of the noise of C components, in units of its shape.

    Attributes:
        is_other: ``(C,)`` bool, whether β is not ½.
        exponent, scale: ``(C,)`` β and s.
        log_odds: ``(C,)`` prior log-odds that an edge is good, minus the logarithm of the uniform density; a term of
            P(good | r).
        component: ``(M,)`` component of every edge.
        log_likelihood: ``(C,)`` nats, of the edges that it was fitted to.
    """

    is_other: Tensor
    exponent: Tensor
    scale: Tensor
    log_odds: Tensor
    component: Tensor
    log_likelihood: Tensor

    @classmethod
    def fitted(
        cls, square: Tensor, of_some: Tensor, component: Tensor, log_volume: Tensor, priors: DensityPriors
    ) -> NoiseDensity:
        """The density of highest likelihood.

        Args:
            square: ``(K,)`` float64, expected squared residuals of some edges, in units of the noise's shape.
            of_some: ``(K,)`` their components.
            component: ``(M,)`` components of all edges.
            log_volume: ``(C,)`` logarithm of the factor by which the shape's units scale a volume.
        """
        count = len(log_volume)
        exponent = square.new_tensor(priors.exponents)[:, None]
        length = square.clamp(min=_LEAST_SQUARE).sqrt()

        def sums(value: Tensor) -> Tensor:
            """``(B, C)`` sums over components of ``(B, K)``."""
            if count == 1:
                return value.sum(dim=1, keepdim=True)
            return value.new_zeros(len(value), count).index_add_(1, of_some, value)

        def of_each(value: Tensor) -> Tensor:
            """``(B, K)`` values of each edge's component, from ``(B, C)``."""
            return value if count == 1 else value[:, of_some]

        number = sums(torch.ones_like(length)[None]).clamp(min=1)
        power, even = length**exponent, _log_even_density(log_volume)
        log_scale = (sums(length.log()[None]) / number).repeat(len(exponent), 1)
        good = torch.full_like(log_scale, priors.good_share)
        # Log-odds that each edge is good.
        log_odds = torch.zeros_like(power)
        for number_of_round in range(priors.rounds + 1):
            if number_of_round > 0:
                share = torch.sigmoid(log_odds)
                known = sums(share)
                scale_power = exponent * sums(share * power) / (3 * known).clamp(min=_LEAST_SQUARE)
                log_scale = (scale_power.log() / exponent).clamp(min=math.log(_LEAST_SQUARE) / 2)
                good = (known / number).clamp(1 / priors.most_certain, 1 - 1 / priors.most_certain)
            beginning = good.logit() + _log_constant(exponent) - 3 * log_scale - even
            log_odds = torch.addcmul(of_each(beginning), power, of_each(torch.exp(-exponent * log_scale)), value=-1)
        # log(π p + (1 − π) even) is the logarithm of the second term plus the softplus of the log-odds.
        likelihood = sums(torch.nn.functional.softplus(log_odds)) + number * ((1 - good).log() + even)
        likeliest = likelihood.max(dim=0)
        # The length that good edges have under each density, in rad: E (r/s)^β = 3/β.
        typical = (log_scale + (3 / exponent).log() / exponent - log_volume / 3).gather(0, likeliest.indices[None])[0]
        is_other = (likeliest.values > likelihood[0] + priors.ahead) & (typical >= math.log(priors.least_length))
        which = torch.where(is_other, likeliest.indices, 0)[None]
        of_chosen = likelihood.gather(0, which)[0]
        chosen = [of_all.gather(0, which)[0] for of_all in (log_scale.exp(), good)]
        return cls(is_other, exponent[which[0], 0], chosen[0], chosen[1].logit() - even, component, of_chosen)

    def weigh(self, square: Tensor, edges: slice | Tensor) -> Tensor:
        """Weights of some edges, from their expected squared residuals."""
        of = self.component[edges]
        square = square.clamp(min=_LEAST_SQUARE)
        exponent, scale, log_odds = (value.to(square)[of] for value in (self.exponent, self.scale, self.log_odds))
        relative = square / scale**2
        power = torch.exp(exponent / 2 * relative.log())
        constant = (_log_constant(self.exponent) - 3 * self.scale.log()).to(square)[of]
        good = torch.sigmoid(log_odds + constant - power)
        return (good * exponent * power / relative + _LEAST_WEIGHT) / scale**2


def _log_constant(exponent: Tensor) -> Tensor:
    """Logarithm of c_β."""
    return exponent.log() - math.log(4 * math.pi) - torch.lgamma(3 / exponent)


def _log_even_density(log_volume: Tensor) -> Tensor:
    """Log density of uniform rotations near the identity; the factor of up to 2.5 farther away is negligible here."""
    return -math.log(8 * math.pi**2) - log_volume
