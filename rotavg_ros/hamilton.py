"""The Hamilton product of quaternions, for components of any kind: numbers, arrays, tensors.

``rotations.py`` has the algebra of tensors, ``solver/algebra/quaternion_rows.py`` that of arrays in rows, and
``online`` that of single quaternions. ``solver/algebra/residuals.py`` fuses the product for large graphs.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any


def hamilton_product(a: Iterable[Any], b: Iterable[Any]) -> tuple[Any, Any, Any, Any]:
    """Components x, y, z, w of ``a ∘ b``, which rotates by ``b`` first, from those of both."""
    ax, ay, az, aw = a
    bx, by, bz, bw = b
    return (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
