"""The row-wise twin of ``rotations.py``: the same algebra in numpy, components in rows, ``(4, n)``.

A SLAM solve of a few hundred edges spends more time calling operations than computing, and a call to NumPy takes half
as long as a call to torch. The conventions are those of ``rotations.py``; the tests compare the two.
"""

from __future__ import annotations

import numpy as np

from rotavg_ros.hamilton import hamilton_product
from rotavg_ros.solver.algebra import quaternion_loops
from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.quaternion_loops import MIN_SQUARE

_product, _inverse, _unit = quaternion_loops.product, quaternion_loops.inverse, quaternion_loops.unit
_log, _exp, _rotate = quaternion_loops.log, quaternion_loops.exp, quaternion_loops.rotate


def multiply(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Hamilton product ``a ∘ b``, ``(4, n)``; either may be one rotation for all, ``(4, 1)``."""
    # A matrix product would wake all threads of BLAS, which takes twice the CPU time of a whole tick.
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


def identities(count: int) -> np.ndarray:
    """``(4, count)``."""
    return np.tile(np.array([[0.0], [0.0], [0.0], [1.0]]), count)


def angle(cosine: np.ndarray) -> np.ndarray:
    """Angles in rad of rotations whose quaternions have this w, of either sign."""
    return np.asarray(2 * np.arccos(np.minimum(np.abs(cosine), 1.0)))


def log(a: np.ndarray) -> np.ndarray:
    """Unit quaternions of either sign → rotation vectors ``(3, n)`` in radians, of length at most π."""
    vector = a[:3]
    sine = np.sqrt(np.maximum(np.einsum("in,in->n", vector, vector), MIN_SQUARE))
    # The arc tangent has the sign of w, so the vector comes out the same for a quaternion and its negative.
    with np.errstate(divide="ignore"):
        half_angle = np.arctan(sine / a[3])
    return np.asarray(vector * (2 * half_angle / sine))


def exp(vector: np.ndarray) -> np.ndarray:
    """Rotation vectors ``(3, n)`` in radians → unit quaternions ``(4, n)``."""
    half_angle = np.sqrt(np.maximum(np.einsum("in,in->n", vector, vector), MIN_SQUARE)) / 2
    quaternion = np.empty((4, vector.shape[1]))
    np.multiply(vector, np.sin(half_angle) / (2 * half_angle), out=quaternion[:3])
    np.cos(half_angle, out=quaternion[3])
    return quaternion


def matrices(a: np.ndarray) -> np.ndarray:
    """Unit quaternions → rotation matrices ``(n, 3, 3)``."""
    x, y, z, w = a
    rows = np.empty((a.shape[1], 3, 3))
    rows[:, 0, 0], rows[:, 1, 1], rows[:, 2, 2] = (
        1 - 2 * (y * y + z * z),
        1 - 2 * (x * x + z * z),
        1 - 2 * (x * x + y * y),
    )
    rows[:, 0, 1], rows[:, 1, 0] = 2 * (x * y - z * w), 2 * (x * y + z * w)
    rows[:, 0, 2], rows[:, 2, 0] = 2 * (x * z + y * w), 2 * (x * z - y * w)
    rows[:, 1, 2], rows[:, 2, 1] = 2 * (y * z - x * w), 2 * (y * z + x * w)
    return rows


def residual(correction: np.ndarray, measured: np.ndarray, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """e_uv ``(4, E)`` of either sign, as ``residuals.edge_residual`` computes it, from ``(4, K)`` and ``(4, E)``."""
    at_target = correction.take(target, axis=1)
    np.negative(at_target[:3], out=at_target[:3])
    return multiply(at_target, multiply(measured, correction.take(source, axis=1)))


@compiled
def residual_vectors(
    correction: np.ndarray, measured: np.ndarray, source: np.ndarray, target: np.ndarray
) -> np.ndarray:
    """Rotation vectors ``(E, 3)`` in rad, of length at most π: :func:`log` of :func:`residual`, edge by edge."""
    vectors = np.empty((len(source), 3))
    for e in range(len(source)):
        u, v = source[e], target[e]
        m = measured[0, e], measured[1, e], measured[2, e], measured[3, e]
        at_source = correction[0, u], correction[1, u], correction[2, u], correction[3, u]
        at_target = correction[0, v], correction[1, v], correction[2, v], correction[3, v]
        vectors[e, 0], vectors[e, 1], vectors[e, 2] = _log(_product(_inverse(at_target), _product(m, at_source)))
    return vectors


@compiled
def spread(orientation: np.ndarray, correction: np.ndarray, between: np.ndarray, fraction: np.ndarray) -> np.ndarray:
    """Orientations R C ``(N, 4)``, where C is interpolated between two corrections.

    Args:
        orientation: ``(N, 4)`` R.
        correction: ``(K, 4)``.
        between: ``(N, 2)`` indices of the two corrections.
        fraction: ``(N,)`` 0 at the first of them, 1 at the second.
    """
    turned = np.empty((len(orientation), 4))
    last, turn = (-1, -1), (0.0, 0.0, 0.0)
    for n in range(len(orientation)):
        u, v = between[n, 0], between[n, 1]
        own = correction[u, 0], correction[u, 1], correction[u, 2], correction[u, 3]
        if u != v:
            if (u, v) != last:
                other = correction[v, 0], correction[v, 1], correction[v, 2], correction[v, 3]
                last, turn = (u, v), _log(_product(_inverse(own), other))
            part = fraction[n]
            own = _product(own, _exp((part * turn[0], part * turn[1], part * turn[2])))
        before = orientation[n, 0], orientation[n, 1], orientation[n, 2], orientation[n, 3]
        turned[n, 0], turned[n, 1], turned[n, 2], turned[n, 3] = _unit(_product(before, own))
    return turned


@compiled
def turned_back(orientation: np.ndarray, which: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """Vectors ``(n, 3)``, each turned by the inverse of orientation ``which`` ``(n,)`` of ``(N, 4)``."""
    turned = np.empty((len(vector), 3))
    for n in range(len(vector)):
        at = which[n]
        back = _inverse((orientation[at, 0], orientation[at, 1], orientation[at, 2], orientation[at, 3]))
        turned[n, 0], turned[n, 1], turned[n, 2] = _rotate(back, (vector[n, 0], vector[n, 1], vector[n, 2]))
    return turned
