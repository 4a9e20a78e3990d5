"""Residuals of all edges at given orientations, in slices that stay in a core's cache.

Inside a slice, a quaternion's four components are four contiguous rows: one component of many edges lies together,
which makes the algebra three times as fast as on rows of four. ``fine_net.edge_residual`` is the same formula, to be
read.
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.parallel import for_each, slices
from rotavg_ros.view_graph import ViewGraph

SLICE_EDGES = 16_384
# Below this squared sine the series of x / sin(x) is exact to double precision.
_SMALL_SINE_SQUARED = 1e-8


class EdgeResiduals:
    """``e_uv = R_v⁻¹ R̃_uv R_u`` of any slice of a graph's edges, w ≥ 0.

    Args:
        graph: M edges.
        body_from_world: ``(N, 4)``; its type is that of the results.
    """

    def __init__(self, graph: ViewGraph, body_from_world: Tensor) -> None:
        self._graph = graph
        self._orientation = body_from_world.t().contiguous()
        self._inverse = self._orientation.clone()
        self._inverse[:3].neg_()

    def quaternions(self, edges: slice) -> Tensor:
        """``(4, k)``."""
        graph = self._graph
        measured = graph.target_from_source[edges].to(self._orientation.dtype).t().contiguous()
        at_source = self._orientation.index_select(1, graph.source[edges])
        at_target = self._inverse.index_select(1, graph.target[edges])
        residual = multiply_rows(at_target, multiply_rows(measured, at_source))
        return residual.mul_(1 - 2 * (residual[3] < 0).to(residual))

    def vectors(self, edges: slice) -> Tensor:
        """Rotation vectors ``(3, k)`` in radians, of length at most π."""
        return log_rows(self.quaternions(edges))

    def angles(self) -> Tensor:
        """``(M,)`` radians."""
        angles = self._orientation.new_empty(self._graph.num_edges)

        def write(edges: slice) -> None:
            residual = self.quaternions(edges)
            sine = (residual[:3] * residual[:3]).sum(dim=0).sqrt()  # four times as fast as torch's norm over rows
            angles[edges] = 2 * torch.atan2(sine, residual[3])

        for_each(write, slices(len(angles), SLICE_EDGES, angles.device))
        return angles


def log_rows(a: Tensor) -> Tensor:
    """Unit quaternions with w ≥ 0 whose components are rows, ``(4, k)`` → rotation vectors ``(3, k)`` in radians."""
    vector, cosine = a[:3], a[3]
    sine_squared = (vector * vector).sum(dim=0)
    sine = sine_squared.sqrt()
    factor = 2 * torch.atan2(sine, cosine) / sine
    return vector * torch.where(sine_squared < _SMALL_SINE_SQUARED, 2 + sine_squared / 3, factor)


def multiply_rows(a: Tensor, b: Tensor) -> Tensor:
    """Hamilton product ``a ∘ b`` of quaternions whose components are rows, ``(4, k)``."""
    product = torch.empty_like(b)
    (ax, ay, az, aw), (bx, by, bz, bw), (x, y, z, w) = a, b, product
    torch.mul(aw, bx, out=x).addcmul_(ax, bw).addcmul_(ay, bz).addcmul_(az, by, value=-1)
    torch.mul(aw, by, out=y).addcmul_(ay, bw).addcmul_(az, bx).addcmul_(ax, bz, value=-1)
    torch.mul(aw, bz, out=z).addcmul_(az, bw).addcmul_(ax, by).addcmul_(ay, bx, value=-1)
    torch.mul(aw, bw, out=w).addcmul_(ax, bx, value=-1).addcmul_(ay, by, value=-1).addcmul_(az, bz, value=-1)
    return product
