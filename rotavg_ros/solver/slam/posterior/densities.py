"""The densities of single edges, each as its logarithm in nats; residuals are rotation vectors in k components."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from rotavg_ros.solver.slam.noise.exceedance import exceedance
from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.posterior.priors import SlamPriors

# Rad.
_QUARTER_TURN = np.pi / 2


class Tails(NamedTuple):
    """The tails of n good edges.

    Attributes:
        share: ``(n,)`` t, probability that each is in the tails.
        ratio: ``(n,)`` τ, factor of its variance there.
        told: ``(n,)`` φ, exponent on the components' likelihood ratio: less than 1 where components are dependent.
    """

    share: np.ndarray
    ratio: np.ndarray
    told: np.ndarray

    def of(self, edges: np.ndarray) -> Tails:
        """The tails of some edges."""
        return Tails(self.share[edges], self.ratio[edges], self.told[edges])


def anyhow(components: int) -> float:
    """rad², variance of the normal density whose value at zero is that of the uniform density over rotations."""
    volume = 2 * np.pi if components == 1 else 8 * np.pi**2
    return float(volume ** (2 / components) / (2 * np.pi))


def log_normal(square: np.ndarray, variance: np.ndarray | float, components: int) -> np.ndarray:
    """Log N(r; variance) in k components for ‖r‖² = ``square``."""
    return np.asarray(-square / (2 * variance) - components / 2 * np.log(2 * np.pi * variance))


def log_good(
    square: np.ndarray,
    variance: np.ndarray,
    predicted: np.ndarray | float,
    components: int,
    tails: Tails,
) -> tuple[np.ndarray, np.ndarray]:
    """Good edges: log N(r; v + p) + log [(1 − t) + t (N(r; τ v + p) / N(r; v + p))^φ], and the share of the first term.

    Args:
        square: ``(n,)`` rad², ‖r‖².
        variance: ``(n,)`` rad², v, of the edge's own noise.
        predicted: rad², p, variance of the prediction that r is compared with.
        components: k.
        tails: t, τ and φ.
    """
    normal = log_normal(square, variance + predicted, components)
    exact = normal + np.log1p(-tails.share)
    with np.errstate(divide="ignore"):
        farther = log_normal(square, tails.ratio * variance + predicted, components) - normal
        tail = normal + tails.told * farther + np.log(tails.share)
    both = np.logaddexp(exact, tail)
    return both, np.exp(exact - both)


def beyond(
    angle: float, square: np.ndarray, variance: np.ndarray, predicted: np.ndarray, components: int, tails: Tails
) -> np.ndarray:
    """``(n,)`` probability that the noise of a good edge exceeds ``angle``, rad.

    It follows from the prediction by others, N(μ, p), and the edge's own density of :func:`log_good`.
    """
    _, exact = log_good(square, variance, predicted, components, tails)
    chances = []
    for total in (variance, tails.ratio * variance):
        part = total / (total + predicted)
        chances.append(exceedance(part * np.sqrt(square), part * predicted, angle, components))
    return np.asarray(exact * chances[0] + (1 - exact) * chances[1])


@dataclass(frozen=True)
class Sites:
    """The normal density that approximates a good edge's own density (n edges).

    All other edges predict a residual as N(μ, p). If the edge's density were N(0, 1/w), the residual would be
    μ / (1 + w p). For a mixture of normal densities with variances v_z, whose probabilities given μ and p are π_z, it
    is μ Σ π_z v_z / (v_z + p). w is chosen so that both agree (expectation propagation, Minka 2001, matching the mean):
    for an edge without any prediction 1/w is the mean variance, for one with an exact prediction w is the mean
    precision.

    Attributes:
        square: ``(n,)`` rad², ‖μ‖².
        predicted: ``(n,)`` rad², p.
        weight: ``(n,)`` rad⁻², w.
        shrinkage: ``(n,)`` Σ π_z v_z / (v_z + p).
        misfit: ``(n,)`` Σ π_z ‖μ v_z / (v_z + p)‖² / v_z.
        log_density: ``(n,)`` nats, log ∫ N(r; μ, p) p(r) dr.
    """

    square: np.ndarray
    predicted: np.ndarray
    weight: np.ndarray
    shrinkage: np.ndarray
    misfit: np.ndarray
    log_density: np.ndarray

    @classmethod
    def of(
        cls,
        square: np.ndarray,
        variance: np.ndarray,
        predicted: np.ndarray,
        components: int,
        tails: Tails,
    ) -> Sites:
        """The sites of the densities of :func:`log_good`."""
        log_density, exact = log_good(square, variance, predicted, components, tails)
        near = exact / (variance + predicted)
        far = (1 - exact) / (tails.ratio * variance + predicted)
        shrinkage = variance * (near + tails.ratio * far)
        misfit = near / (variance + predicted) + tails.ratio * far / (tails.ratio * variance + predicted)
        return cls(square, predicted, (near + far) / shrinkage, shrinkage, square * variance * misfit, log_density)


def log_false(
    square: np.ndarray,
    components: int,
    priors: SlamPriors,
    near_miss_share: np.ndarray | float | None = None,
    predicted: np.ndarray | float = 0.0,
) -> np.ndarray:
    """Closures that are false by themselves: log [(1 − m) u(r) + ½ m N(r; near miss + p) + ½ m h(r)].

    u is uniform over rotations. A place may be mistaken for one that looks alike and is seen at nearly the same angle,
    or from the opposite end, as in a corridor: h is equally wide around half a turn, about any axis.

    Args:
        square: rad², ‖r‖².
        components: k.
        priors: width of the near misses, and m if it is not given.
        near_miss_share: m, broadcast against ``square``.
        predicted: rad², p, variance of the prediction that r is counted from.
    """
    share = priors.near_miss_share if near_miss_share is None else near_miss_share
    variance = np.radians(priors.near_miss_deg) ** 2
    uniform = log_uniform_density(np.sqrt(square), components) + np.log1p(-share)
    near = log_normal(square, variance + predicted, components)
    half_turn = log_half_turn(np.sqrt(square), variance + predicted, components)
    return np.asarray(np.logaddexp(uniform, np.logaddexp(near, half_turn) + np.log(share / 2)))


def log_half_turn(angle: np.ndarray, variance: np.ndarray | float, components: int) -> np.ndarray:
    """Log density of turns by ``angle``, rad, normal around half a turn about any axis, with ``variance`` rad².

    In three components, angles of less than a quarter turn count as a quarter turn in the volume element. So even a
    broad density has no peak at the identity.
    """
    angle = np.minimum(angle, np.pi)
    density = log_normal((np.pi - angle) ** 2, variance, 1)
    if components == 3:  # from the density of the angle, uniform over axes
        density = density + np.log(2.0) - np.log(4 * np.pi * np.maximum(angle, _QUARTER_TURN) ** 2)
    return np.asarray(density)


def log_slipped(
    square: np.ndarray, variance: np.ndarray, predicted: np.ndarray | float, components: int, priors: SlamPriors
) -> np.ndarray:
    """Segments in which a step slipped: log N(r; slip² + v + p); the arguments are those of :func:`log_good`."""
    return log_normal(square, np.radians(priors.slip_deg) ** 2 + variance + predicted, components)
