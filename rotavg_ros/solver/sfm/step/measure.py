"""How residuals are measured and weighted, and what is measured."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.sfm.laplacians.groups import Group
from rotavg_ros.solver.sfm.noise_shape import NoiseShape, share_of_first
from rotavg_ros.solver.sfm.symmetric_rows import distinct_entries, full, times


class Measure(NamedTuple):
    """How residuals are measured and weighted.

    Attributes:
        shape: shape of the noise.
        variance: ``(N,)`` variances of the nodes, in units of the shape; without numerical floors.
        weigh: function (expected squared residuals of edges, which edges these are) → robust weights.
        is_single: ``(C,)`` bool, components whose residuals and systems are in single precision if they are well knit;
            elsewhere precision is double. In NumPy, so that a step does not wait for an accelerator.
        source_share: ``(M,)`` probability that each edge's noise is in its source's frame; None: from residuals.
        unit: ``(6, M)`` entries of T in the world's frame: residuals r count as T r (``stated/shape.py``), and the
            noise's shape is that of T r; None: T = 1.
        is_held: ``(M,)`` bool, edges that have their ``source_share``, if there is one; others' is from residuals.
            None: all.
    """

    shape: NoiseShape
    variance: Tensor
    weigh: Callable[[Tensor, slice | Tensor], Tensor]
    is_single: np.ndarray
    source_share: Tensor | None = None
    unit: Tensor | None = None
    is_held: Tensor | None = None

    def in_units(self, vector: Tensor, edges: slice | Tensor) -> Tensor:
        """``T r`` of some edges with residuals ``(3, k)``; or ``T`` times their pulls."""
        return vector if self.unit is None else times(self.unit[:, edges].to(vector), vector)

    def of(self, group: Group) -> Measure:
        """The same for the edges of a group alone."""
        edge = group.edge
        if edge is None:
            return self
        share, unit, is_held = (
            None if value is None else group.of(value) for value in (self.source_share, self.unit, self.is_held)
        )
        return self._replace(
            weigh=lambda square, edges: self.weigh(square, edge[edges]), source_share=share, unit=unit, is_held=is_held
        )

    def rows(self, dtype: torch.dtype) -> Tensor:
        """The nodes' values used by their edges, ``(k, N)``: variance and, unless noise is round, six shape entries."""
        variance = self.variance[None]
        if self.shape.covariance is None:
            return variance.to(dtype)
        return torch.cat((variance, distinct_entries(self.shape.information))).to(dtype)


class Expected(NamedTuple):
    """Residuals ``(3, k)`` as measured by a :class:`Measure`.

    Attributes:
        pull: ``(3, k)`` Ω r.
        square: ``(k,)`` rᵀ Ω r.
        variance: ``(k,)`` sum over both ends.
        source_share: ``(k,)`` probability that the noise is in the source's frame; Ω is the mean of both ends'.
    """

    pull: Tensor
    square: Tensor
    variance: Tensor
    source_share: Tensor

    @staticmethod
    def information(at_source: Tensor, at_target: Tensor, source_share: Tensor) -> Tensor:
        """Ω ``(3, 3, k)``, given :meth:`Measure.rows` of both ends and the share."""
        if len(at_source) == 1:
            unit = torch.eye(3, dtype=at_source.dtype, device=at_source.device)
            return unit[:, :, None].expand(3, 3, len(source_share))
        return full(torch.lerp(at_target[1:], at_source[1:], source_share))

    @classmethod
    def of(
        cls,
        vector: Tensor,
        at_source: Tensor,
        at_target: Tensor,
        source_share: Tensor | None = None,
        is_held: Tensor | None = None,
    ) -> Expected:
        """From residuals, given :meth:`Measure.rows` of both ends, and the source share where it is held fixed.

        Args:
            is_held: ``(k,)`` bool, edges whose source share is held; None: all.
        """
        variance = at_source[0] + at_target[0]
        if len(at_source) == 1:  # noise is round: Ω = 1
            square = dot(vector, vector)
            return cls(vector, square, variance, torch.full_like(square, 0.5))
        if source_share is not None and is_held is None:
            pull = times(torch.lerp(at_target[1:], at_source[1:], source_share), vector)
            return cls(pull, dot(vector, pull), variance, source_share)
        pulls = [times(end[1:], vector) for end in (at_source, at_target)]
        squares = [dot(vector, pull) for pull in pulls]
        share = share_of_first(*squares)
        if source_share is not None and is_held is not None:
            share = torch.where(is_held, source_share, share)
        square = torch.lerp(squares[1], squares[0], share)
        return cls(torch.lerp(pulls[1], pulls[0], share), square, variance, share)


def l1_weight(squared_residual: Tensor, _: slice | Tensor) -> Tensor:
    """Weight of the ℓ1 cost, of squared residuals s = |r|²: s^(−1/2) = |r|⁻¹."""
    return squared_residual.rsqrt()


def l_half_weight(squared_residual: Tensor, _: slice | Tensor) -> Tensor:
    """Weight of the ℓ½ cost, of squared residuals s = |r|²: s^(−3/4) = |r|^(−3/2).

    Two roots take a fifth of the time of a power.
    """
    return (squared_residual * squared_residual.sqrt()).rsqrt_()


def dot(a: Tensor, b: Tensor) -> Tensor:
    """Inner products ``(k,)`` of columns ``(3, k)``, a third faster than a sum over rows."""
    return torch.mul(a[0], b[0]).addcmul_(a[1], b[1]).addcmul_(a[2], b[2])
