"""The shape of a graph's noise: about which axes of the cameras' own frames measurements are exact.

Two views fix the turn about the optical axis far better than pan and tilt, which trade against the translation
(Daniilidis & Spetsakis 1997; of the Lund data's Sphinx, the errors about x, y and z are as 2.4 : 1.5 : 1). The shape is
estimated from residuals; nothing is known of it beforehand. An edge's direction is its maker's choice, and noise may
belong to either end's frame, so each end has a shape of its own; that of the wrong end comes out rounder.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.threads import for_each, threads_on

# From nothing, and from what the last step's residuals said.
_ITERATIONS, _FURTHER_ITERATIONS = 10, 3
# No axis is believed to be more exact than this share of the worst; none is more exact than this angle.
_MIN_RATIO = 0.1
_MIN_SCALE = np.radians(1e-4)
# The shape of so many further residuals is taken to be round: what few residuals say is chance.
_ROUND_RESIDUALS = 20


@dataclass(frozen=True)
class NoiseShape:
    """Information matrices in the world's frame (N nodes): edge u→v has ``at_source[u] + at_target[v]``.

    Attributes:
        at_source, at_target: ``(N, 3, 3)`` rad⁻², symmetric.
        scatter: what they were estimated as in the cameras' frames, ``(C, 3, 3)`` at either end; None: nothing was.
    """

    at_source: Tensor
    at_target: Tensor
    scatter: tuple[Tensor, Tensor] | None = None

    @classmethod
    def round(cls, num_nodes: int, device: torch.device) -> NoiseShape:
        """Every edge has the unit matrix."""
        half = torch.eye(3, dtype=torch.float64, device=device).expand(num_nodes, 3, 3) / 2
        return cls(half, half)

    @classmethod
    def estimate(
        cls,
        residual: Tensor,
        source: Tensor,
        target: Tensor,
        body_from_world: Tensor,
        component: Tensor,
        redundancy: Tensor,
        before: NoiseShape | None = None,
    ) -> NoiseShape:
        """From the residuals at given orientations, every component for itself.

        Args:
            residual: ``(K, 3)`` rotation vectors of some edges in the world's frame, radians.
            source, target: ``(K,)`` ends of these edges.
            body_from_world: ``(N, 4)``.
            component: ``(N,)``.
            redundancy: ``(C,)`` how many edges each component has beyond a spanning tree.
            before: what was estimated a step ago.
        """
        matrix = rotations.to_matrix(body_from_world)
        starts = (None, None) if before is None or before.scatter is None else before.scatter
        ends = (source, target)
        shapes, scatters = [matrix] * 2, [matrix] * 2

        def estimate(number: int) -> None:
            end = ends[number]
            in_camera = (matrix[end] @ residual[:, :, None]).squeeze(-1)
            scatters[number] = scatter(in_camera, component[end], len(redundancy), starts[number])
            covariance = _as_far_as_supported(scatters[number], redundancy)
            information = torch.linalg.inv_ex(covariance).inverse[component] / 2
            shapes[number] = matrix.transpose(1, 2) @ information @ matrix

        for_each(estimate, (0, 1), threads_on(residual.device))
        return cls(shapes[0], shapes[1], (scatters[0], scatters[1]))


def scatter(vectors: Tensor, group: Tensor, num_groups: int, start: Tensor | None = None) -> Tensor:
    """Robust covariance ``(G, 3, 3)`` about zero of the vectors ``(K, 3)`` of each group ``(K,)``, up to its scale.

    The maximum likelihood estimate for Student's t with one degree of freedom (Kent & Tyler 1991), sought from
    ``start``, an estimate from much the same vectors.
    """
    rows = vectors.t().contiguous()
    count = torch.bincount(group, minlength=num_groups).clamp(min=1)[:, None, None]
    unit = torch.eye(3, dtype=vectors.dtype, device=vectors.device)

    def second_moment(weight: Tensor) -> Tensor:
        if num_groups == 1:  # a matrix product adds up many times as fast
            total = ((weight * rows) @ rows.t()).flatten()[:, None]
        else:
            products = ((weight * rows)[:, None] * rows[None]).flatten(0, 1)
            total = products.new_zeros(9, num_groups).index_add_(1, group, products)
        moment: Tensor = _MIN_SCALE**2 * unit + total.t().reshape(-1, 3, 3) / count
        return moment

    def squared_lengths(covariance: Tensor) -> Tensor:
        inverse = torch.linalg.inv_ex(covariance).inverse
        turned = inverse[0] @ rows if num_groups == 1 else (inverse.permute(1, 2, 0)[:, :, group] * rows).sum(dim=1)
        squares: Tensor = (rows * turned).sum(dim=0)
        return squares

    if start is None:
        mean_square = second_moment(torch.ones_like(rows[0])).diagonal(dim1=1, dim2=2).mean(dim=1)
        covariance, iterations = mean_square[:, None, None] * unit, _ITERATIONS
    else:
        covariance, iterations = start, _FURTHER_ITERATIONS
    for _ in range(iterations):
        covariance = second_moment(4 / (1 + squared_lengths(covariance)))
    return covariance


def _as_far_as_supported(covariance: Tensor, redundancy: Tensor) -> Tensor:
    """The covariances ``(G, 3, 3)``, rounder the fewer residuals ``(G,)`` speak for them, and not too flat."""
    unit = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    mean_variance = covariance.diagonal(dim1=1, dim2=2).mean(dim=1)
    support = (redundancy / (redundancy + _ROUND_RESIDUALS))[:, None, None]
    variance, axes = torch.linalg.eigh(support * covariance + (1 - support) * mean_variance[:, None, None] * unit)
    bounded = torch.maximum(variance, _MIN_RATIO**2 * variance[:, -1:])
    return torch.matmul(axes, bounded[:, :, None] * axes.transpose(1, 2))
