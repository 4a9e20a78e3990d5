"""The row-wise twin of ``rotations.py``: the same algebra in numpy, components in rows, ``(4, n)``.

A SLAM solve of a few hundred edges spends more time in calling operations than in them, and a call of numpy's takes
half as long as one of torch's. The conventions are those of ``rotations.py``; the tests compare the two.
"""

from __future__ import annotations

import math

import numpy as np

from rotavg_ros.hamilton import hamilton_product
from rotavg_ros.solver.algebra.compiled import compiled

# So small a squared sine or angle counts as this, which makes angle / sine what it is in the limit instead of 0/0.
_MIN_SQUARE = 1e-30


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product ``a ∘ b``, ``(4, n)``; either may be one rotation for all, ``(4, 1)``."""
    # A matrix product would wake all threads of BLAS for this: twice the CPU time of a whole tick.
    product = np.empty(np.broadcast_shapes(a.shape, b.shape))
    product[0], product[1], product[2], product[3] = hamilton_product(a, b)
    return product


def inverse(a: np.ndarray) -> np.ndarray:
    """Inverse of unit quaternions."""
    conjugate = -a
    conjugate[3] = a[3]
    return conjugate


def normalize(a: np.ndarray) -> np.ndarray:
    """Unit quaternions of the same signs."""
    return np.asarray(a / np.sqrt(np.einsum("in,in->n", a, a)))


def log(a: np.ndarray) -> np.ndarray:
    """Unit quaternions of either sign → rotation vectors ``(3, n)`` in radians, of length at most π."""
    vector = a[:3]
    sine = np.sqrt(np.maximum(np.einsum("in,in->n", vector, vector), _MIN_SQUARE))
    # The arc tangent has the sign of w, so the vector comes out the same for a quaternion and its negative.
    with np.errstate(divide="ignore"):
        half_angle = np.arctan(sine / a[3])
    return np.asarray(vector * (2 * half_angle / sine))


def exp(vector: np.ndarray) -> np.ndarray:
    """Rotation vectors ``(3, n)`` in radians → unit quaternions ``(4, n)``."""
    half_angle = np.sqrt(np.maximum(np.einsum("in,in->n", vector, vector), _MIN_SQUARE)) / 2
    quaternion = np.empty((4, vector.shape[1]))
    np.multiply(vector, np.sin(half_angle) / (2 * half_angle), out=quaternion[:3])
    np.cos(half_angle, out=quaternion[3])
    return quaternion


def residual(correction: np.ndarray, measured: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """``(4, E)`` of either sign: e_uv as ``residuals.edge_residual`` computes it, from ``(4, K)`` and ``(4, E)``."""
    at_target = correction.take(target, axis=1)
    np.negative(at_target[:3], out=at_target[:3])
    return multiply(at_target, multiply(measured, correction.take(source, axis=1)))


@compiled
def residual_vectors(
    correction: np.ndarray, measured: np.ndarray, source: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """``(E, 3)`` rad, of any length at most π: what :func:`log` makes of :func:`residual`, edge by edge."""
    vectors = np.empty((len(source), 3))
    for e in range(len(source)):
        u, v = source[e], target[e]
        ax, ay, az, aw = measured[0, e], measured[1, e], measured[2, e], measured[3, e]
        bx, by, bz, bw = correction[0, u], correction[1, u], correction[2, u], correction[3, u]
        mx = aw * bx + ax * bw + ay * bz - az * by
        my = aw * by - ax * bz + ay * bw + az * bx
        mz = aw * bz + ax * by - ay * bx + az * bw
        mw = aw * bw - ax * bx - ay * by - az * bz
        cx, cy, cz, cw = -correction[0, v], -correction[1, v], -correction[2, v], correction[3, v]
        x = cw * mx + cx * mw + cy * mz - cz * my
        y = cw * my - cx * mz + cy * mw + cz * mx
        z = cw * mz + cx * my - cy * mx + cz * mw
        w = cw * mw - cx * mx - cy * my - cz * mz
        sine = math.sqrt(max(x * x + y * y + z * z, _MIN_SQUARE))
        # The sign of w makes the vector the same for a quaternion and its negative.
        scale = 2 * math.atan2(sine, abs(w)) / sine * (1.0 if w >= 0 else -1.0)
        vectors[e, 0], vectors[e, 1], vectors[e, 2] = scale * x, scale * y, scale * z
    return vectors
