"""Single quaternions xyzw within compiled loops: the algebra of ``rotations.py``, number by number."""

from __future__ import annotations

import math

from rotavg_ros.hamilton import hamilton_product
from rotavg_ros.solver.algebra.compiled import compiled

# Lower bound on a squared sine or angle. It makes angle / sine equal to its limit instead of 0/0.
MIN_SQUARE = 1e-30

Vector = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]

product = compiled(hamilton_product)


@compiled
def inverse(a: Quaternion) -> Quaternion:
    """Inverse of a unit quaternion."""
    return -a[0], -a[1], -a[2], a[3]


@compiled
def unit(a: Quaternion) -> Quaternion:
    """The quaternion scaled to unit length, with the same sign."""
    x, y, z, w = a
    length = math.sqrt(x * x + y * y + z * z + w * w)
    return x / length, y / length, z / length, w / length


@compiled
def canonical(a: Quaternion) -> Quaternion:
    """The quaternion of the same rotation with w ≥ 0."""
    x, y, z, w = a
    return (-x, -y, -z, -w) if w < 0.0 else (x, y, z, w)


@compiled
def log(a: Quaternion) -> Vector:
    """Unit quaternion of either sign → rotation vector in radians, of length at most π."""
    x, y, z, w = a
    sine = math.sqrt(max(x * x + y * y + z * z, MIN_SQUARE))
    # The sign of w makes the vector the same for a quaternion and its negative.
    scale = 2 * math.atan2(sine, abs(w)) / sine * (1.0 if w >= 0 else -1.0)
    return scale * x, scale * y, scale * z


@compiled
def exp(vector: Vector) -> Quaternion:
    """Rotation vector in radians → unit quaternion."""
    x, y, z = vector
    half_angle = math.sqrt(max(x * x + y * y + z * z, MIN_SQUARE)) / 2
    scale = math.sin(half_angle) / (2 * half_angle)
    return scale * x, scale * y, scale * z, math.cos(half_angle)


@compiled
def rotate(a: Quaternion, vector: Vector) -> Vector:
    """A vector turned by a unit quaternion: v + 2 w (u × v) + 2 u × (u × v)."""
    x, y, z, w = a
    p, q, r = vector
    tx, ty, tz = 2 * (y * r - z * q), 2 * (z * p - x * r), 2 * (x * q - y * p)
    return p + w * tx + y * tz - z * ty, q + w * ty + z * tx - x * tz, r + w * tz + x * ty - y * tx
