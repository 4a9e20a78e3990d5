"""Symmetric 3 × 3 matrices of many edges or nodes, as six rows: their entries xx, xy, xz, yy, yz, zz."""

from __future__ import annotations

import torch
from torch import Tensor

_DISTINCT = [0, 1, 2, 4, 5, 8]
_FULL = [0, 1, 2, 1, 3, 4, 2, 4, 5]
# Row and column of the six.
ENTRIES = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))


def distinct_entries(matrices: Tensor) -> Tensor:
    """Symmetric matrices ``(3, 3, k)`` → ``(6, k)``."""
    return matrices.flatten(0, 1)[_DISTINCT]


def full(entries: Tensor) -> Tensor:
    """``(6, k)`` → ``(3, 3, k)``."""
    return entries[_FULL].view(3, 3, -1)


def times(entries: Tensor, vector: Tensor) -> Tensor:
    """Products ``(3, k)`` of symmetric matrices ``(6, k)`` and vectors ``(3, k)``."""
    xx, xy, xz, yy, yz, zz = entries
    x, y, z = vector
    product = torch.empty_like(vector)
    torch.mul(xx, x, out=product[0]).addcmul_(xy, y).addcmul_(xz, z)
    torch.mul(xy, x, out=product[1]).addcmul_(yy, y).addcmul_(yz, z)
    torch.mul(xz, x, out=product[2]).addcmul_(yz, y).addcmul_(zz, z)
    return product


def turned(matrices: Tensor, turn: Tensor) -> Tensor:
    """``Tᵀ X T``, all ``(3, 3, k)``."""
    right = (matrices[:, :, None] * turn).sum(dim=1)
    return (turn[:, :, None] * right[:, None]).sum(dim=0)
