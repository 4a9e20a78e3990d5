"""The densities of single edges, each as its logarithm in nats; residuals are rotation vectors in k components."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.noise.mixture import log_uniform_density
from rotavg_ros.solver.slam.posterior.priors import SlamPriors


def log_normal(square: np.ndarray, variance: np.ndarray | float, components: int) -> np.ndarray:
    """Log N(r; variance) in k components for ‖r‖² = ``square``."""
    return np.asarray(-square / (2 * variance) - components / 2 * np.log(2 * np.pi * variance))


def log_good(
    square: np.ndarray, variance: np.ndarray, predicted: np.ndarray | float, components: int, priors: SlamPriors
) -> tuple[np.ndarray, np.ndarray]:
    """Of good edges: log [(1 − t) N(r; v + p) + t N(r; τ v + p)], and the share of the first.

    Args:
        square: ``(n,)`` rad², ‖r‖².
        variance: ``(n,)`` rad², v, of the edge's own noise.
        predicted: rad², p, of what r is compared with.
        components: k.
        priors: of t and τ.
    """
    exact = log_normal(square, variance + predicted, components) + np.log1p(-priors.tail_share)
    tail = log_normal(square, priors.tail_ratio * variance + predicted, components) + np.log(priors.tail_share)
    both = np.logaddexp(exact, tail)
    return both, np.exp(exact - both)


def log_false(square: np.ndarray, components: int, priors: SlamPriors) -> np.ndarray:
    """Of closures that are false by themselves: log [(1 − m) u(r) + m N(r; near misses)], u uniform over rotations."""
    uniform = log_uniform_density(np.sqrt(square), components) + np.log1p(-priors.near_miss_share)
    near = log_normal(square, np.radians(priors.near_miss_deg) ** 2, components) + np.log(priors.near_miss_share)
    return np.asarray(np.logaddexp(uniform, near))


def log_slipped(
    square: np.ndarray, variance: np.ndarray, predicted: np.ndarray | float, components: int, priors: SlamPriors
) -> np.ndarray:
    """Of segments in which a step slipped: log N(r; slip² + v + p); the arguments are those of :func:`log_good`."""
    return log_normal(square, np.radians(priors.slip_deg) ** 2 + variance + predicted, components)
