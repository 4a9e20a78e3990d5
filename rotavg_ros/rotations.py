"""Quaternion algebra on torch tensors.

Every quaternion is ``xyzw`` in the last dimension, unit length, and stands for the rotation that scipy's
``Rotation.from_quat`` reads from the same four numbers. ``multiply(a, b)`` rotates by ``b`` first, then by ``a``.
All functions broadcast over leading dimensions, keep dtype and device, and are differentiable.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor

from rotavg_ros.hamilton import hamilton_product

# Below this squared angle (rad²) the series of sin(x)/x is exact to double precision.
_SMALL_ANGLE_SQUARED = 1e-8
# Variance of a component of a uniformly random rotation's vector, rad²: a third of the mean of θ² (1 − cos θ) / π.
RANDOM_VARIANCE = (math.pi**2 / 3 + 2) / 3


def identity(*shape: int, dtype: torch.dtype = torch.float64, device: torch.device | str | None = None) -> Tensor:
    """Identity rotations, shape ``(*shape, 4)``."""
    quaternion = torch.zeros(*shape, 4, dtype=dtype, device=device)
    quaternion[..., 3] = 1
    return quaternion


def multiply(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product ``a ∘ b``, shapes ``(..., 4)``."""
    return torch.stack(hamilton_product(a.unbind(-1), b.unbind(-1)), dim=-1)


def inverse(a: Tensor) -> Tensor:
    """Inverse of unit quaternions, shape ``(..., 4)``."""
    return torch.cat((-a[..., :3], a[..., 3:]), dim=-1)


def canonical(a: Tensor) -> Tensor:
    """The representative with w ≥ 0 of each rotation."""
    return torch.where(a[..., 3:] < 0, -a, a)


def normalize(a: Tensor) -> Tensor:
    """Unit quaternions with w ≥ 0. The input must not be zero."""
    return canonical(a / a.norm(dim=-1, keepdim=True))


def exp(rotation_vector: Tensor) -> Tensor:
    """Rotation vectors ``(..., 3)`` in radians to unit quaternions ``(..., 4)`` (w ≥ 0 up to an angle of π)."""
    angle_squared = (rotation_vector * rotation_vector).sum(-1, keepdim=True)
    small = angle_squared < _SMALL_ANGLE_SQUARED
    half_angle = torch.where(small, torch.ones_like(angle_squared), angle_squared).sqrt() / 2
    half_sinc = torch.where(small, 0.5 - angle_squared / 48, torch.sin(half_angle) / (2 * half_angle))
    cosine = torch.where(small, 1 - angle_squared / 8, torch.cos(half_angle))
    return torch.cat((rotation_vector * half_sinc, cosine), dim=-1)


def log(a: Tensor) -> Tensor:
    """Unit quaternions ``(..., 4)`` to rotation vectors ``(..., 3)`` in radians, of length at most π."""
    a = canonical(a)
    vector, cosine = a[..., :3], a[..., 3:]
    sine_squared = (vector * vector).sum(-1, keepdim=True)
    small = sine_squared < _SMALL_ANGLE_SQUARED
    sine = torch.where(small, torch.ones_like(sine_squared), sine_squared).sqrt()
    factor = torch.where(small, 2 + sine_squared / 3, 2 * torch.atan2(sine, cosine) / sine)
    return vector * factor


def angle(a: Tensor) -> Tensor:
    """Rotation angle of unit quaternions in radians, in [0, π], shape ``(...)``."""
    return 2 * torch.atan2(a[..., :3].norm(dim=-1), a[..., 3].abs())


def angle_between(a: Tensor, b: Tensor) -> Tensor:
    """Geodesic distance of two rotations in radians, in [0, π]."""
    return angle(multiply(inverse(a), b))


def rotate(a: Tensor, vector: Tensor) -> Tensor:
    """Vectors ``(..., 3)`` turned by the rotations ``a``."""
    twice_cross: Tensor = 2 * torch.linalg.cross(a[..., :3], vector)
    turned: Tensor = vector + a[..., 3:] * twice_cross + torch.linalg.cross(a[..., :3], twice_cross)
    return turned


def turn_form(a: Tensor, form: Tensor) -> Tensor:
    """Quadratic forms ``(..., 3, 3)`` of vectors that are turned by the rotations ``a``: ``A X Aᵀ``."""
    matrix = to_matrix(a)
    return matrix @ form @ matrix.mT


def to_matrix(a: Tensor) -> Tensor:
    """Unit quaternions ``(..., 4)`` to rotation matrices ``(..., 3, 3)``."""
    return torch.stack(
        [rotate(a, basis.expand(*a.shape[:-1], 3)) for basis in torch.eye(3, dtype=a.dtype, device=a.device)], dim=-1
    )


def from_matrix(matrix: Tensor) -> Tensor:
    """Rotation matrices ``(..., 3, 3)`` to unit quaternions ``(..., 4)`` with w ≥ 0.

    Takes, of the four algebraically equal formulas, the one with the largest divisor (Shepperd 1978).
    """
    m = [[matrix[..., row, column] for column in range(3)] for row in range(3)]
    xx, yy, zz = m[0][0], m[1][1], m[2][2]
    xy, xz, yz = m[0][1] + m[1][0], m[0][2] + m[2][0], m[1][2] + m[2][1]
    wx, wy, wz = m[2][1] - m[1][2], m[0][2] - m[2][0], m[1][0] - m[0][1]
    candidates = torch.stack(
        (
            torch.stack((1 + xx - yy - zz, xy, xz, wx), dim=-1),
            torch.stack((xy, 1 - xx + yy - zz, yz, wy), dim=-1),
            torch.stack((xz, yz, 1 - xx - yy + zz, wz), dim=-1),
            torch.stack((wx, wy, wz, 1 + xx + yy + zz), dim=-1),
        ),
        dim=-2,
    )
    best = torch.diagonal(candidates, dim1=-2, dim2=-1).argmax(-1)
    chosen = candidates.gather(-2, best[..., None, None].expand(*best.shape, 1, 4)).squeeze(-2)
    return normalize(chosen)


def slerp(start: Tensor, end: Tensor, fraction: Tensor) -> Tensor:
    """Rotation at ``fraction`` ``(...)`` of the shortest way from ``start`` to ``end``."""
    return multiply(start, exp(fraction[..., None] * log(multiply(inverse(start), end))))


def random(
    *shape: int,
    dtype: torch.dtype = torch.float64,
    device: torch.device | str | None = None,
    generator: torch.Generator | None = None,
) -> Tensor:
    """Rotations drawn uniformly from SO(3), shape ``(*shape, 4)``."""
    return normalize(torch.randn(*shape, 4, dtype=dtype, device=device, generator=generator))
