"""The probability that an uncertain rotation is larger than a given angle."""

from __future__ import annotations

import numpy as np
from scipy.special import ndtr

from rotavg_ros.view_graph import FALSE_CLOSURE_DEG

# Noise above which a closure is false, rad.
OUTLIER_ANGLE = np.radians(FALSE_CLOSURE_DEG)
_SMALLEST = 1e-9


def exceedance(length: np.ndarray, variance: np.ndarray, angle: float, components: int) -> np.ndarray:
    """P(‖x‖ > angle) for rotation vectors x ~ N(m, variance · I) with ‖m‖ = ``length``, ``(E,)``.

    In one component this is a difference of normal distribution functions; in three components (noncentral χ), there
    is a difference of densities as well.

    Args:
        length: ``(E,)`` rad.
        variance: ``(E,)`` rad² per component.
        angle: rad.
        components: 1 or 3.
    """
    sigma = np.sqrt(np.maximum(variance, _SMALLEST**2))
    mean = np.maximum(length, _SMALLEST * sigma + _SMALLEST)
    upper, lower = (angle - mean) / sigma, (-angle - mean) / sigma
    within = ndtr(upper) - ndtr(lower)
    if components == 3:
        density = np.exp(-(upper**2) / 2) * -np.expm1(-2 * angle * mean / sigma**2) / np.sqrt(2 * np.pi)
        within = within - sigma / mean * density
    return np.asarray(np.clip(1 - within, 0.0, 1.0))
