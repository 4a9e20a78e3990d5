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
    """Of n good edges, how many err by far more than others, and by how much.

    Attributes:
        share: ``(n,)`` t, chance of each to be in the tails.
        ratio: ``(n,)`` τ, how many times its variance it has there.
        told: ``(n,)`` φ, how much of what all components tell of that holds: less than 1 where they go together.
    """

    share: np.ndarray
    ratio: np.ndarray
    told: np.ndarray

    def of(self, edges: np.ndarray) -> Tails:
        """Of some of them."""
        return Tails(self.share[edges], self.ratio[edges], self.told[edges])


def anyhow(components: int) -> float:
    """rad², variance of the normal density that has at zero the height of the uniform one over rotations."""
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
    """Of good edges: log N(r; v + p) + log [(1 − t) + t (N(r; τ v + p) / N(r; v + p))^φ], and the share of the first.

    Args:
        square: ``(n,)`` rad², ‖r‖².
        variance: ``(n,)`` rad², v, of the edge's own noise.
        predicted: rad², p, of what r is compared with.
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

    What others say of the residual, N(μ, p), and its own density, of :func:`log_good`, tell it together.
    """
    _, exact = log_good(square, variance, predicted, components, tails)
    chances = []
    for total in (variance, tails.ratio * variance):
        part = total / (total + predicted)
        chances.append(exceedance(part * np.sqrt(square), part * predicted, angle, components))
    return np.asarray(exact * chances[0] + (1 - exact) * chances[1])


@dataclass(frozen=True)
class Sites:
    """The normal density that stands for a good edge's own one (n edges).

    What all other edges say of a residual is N(μ, p). Were the edge's density N(0, 1/w), the residual would come out as
    μ / (1 + w p). Of a mixture of normal densities of variances v_z, which hold with chances π_z given μ and p, it
    comes out as μ Σ π_z v_z / (v_z + p). w is chosen so that both agree (expectation propagation, Minka 2001, by the
    mean): where nothing else tells of an edge 1/w is the mean variance, where all is told w is the mean precision.

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
        """Of densities of :func:`log_good`."""
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
    """Of closures that are false by themselves: log [(1 − m) u(r) + ½ m N(r; near miss + p) + ½ m h(r)].

    u is uniform over rotations. A place is mistaken for one that looks alike and is seen at nearly the same angle, or
    from the other end, as a corridor is: h is as wide about half a turn, about any axis.

    Args:
        square: rad², ‖r‖².
        components: k.
        priors: the near misses' width, and m where it is not given.
        near_miss_share: m, broadcast against ``square``.
        predicted: rad², p, where what r is counted from is not known any better.
    """
    share = priors.near_miss_share if near_miss_share is None else near_miss_share
    variance = np.radians(priors.near_miss_deg) ** 2
    uniform = log_uniform_density(np.sqrt(square), components) + np.log1p(-share)
    near = log_normal(square, variance + predicted, components)
    half_turn = log_half_turn(np.sqrt(square), variance + predicted, components)
    return np.asarray(np.logaddexp(uniform, np.logaddexp(near, half_turn) + np.log(share / 2)))


def log_half_turn(angle: np.ndarray, variance: np.ndarray | float, components: int) -> np.ndarray:
    """Of turns by ``angle``, rad, that are normal about half a turn about any axis, with ``variance`` rad².

    In three components angles of less than a quarter turn count as one in the volume that they share out: however
    broad the density, none of it gathers at the identity.
    """
    angle = np.minimum(angle, np.pi)
    density = log_normal((np.pi - angle) ** 2, variance, 1)
    if components == 3:  # from the angle's density, all axes alike
        density = density + np.log(2.0) - np.log(4 * np.pi * np.maximum(angle, _QUARTER_TURN) ** 2)
    return np.asarray(density)


def log_slipped(
    square: np.ndarray, variance: np.ndarray, predicted: np.ndarray | float, components: int, priors: SlamPriors
) -> np.ndarray:
    """Of segments in which a step slipped: log N(r; slip² + v + p); the arguments are those of :func:`log_good`."""
    return log_normal(square, np.radians(priors.slip_deg) ** 2 + variance + predicted, components)
