"""The shape of a graph's noise: about which axes of the cameras' own frames measurements are exact.

Two views fix the turn about the optical axis far better than pan and tilt, which trade against the translation
(Daniilidis & Spetsakis 1997; of the Lund data's Sphinx, the errors about x, y and z are as 2.4 : 1.5 : 1). The shape is
estimated from residuals; nothing is known of it beforehand. An edge's direction is its maker's choice, and noise may
belong to either end's frame, so each end has a shape of its own; that of the wrong end comes out rounder.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.threads import for_each, threads_on
from rotavg_ros.solver.sfm.priors import NoiseShapePriors


class ResidualSample(NamedTuple):
    """Residuals of some edges, K of them.

    Attributes:
        vector: ``(3, K)`` rotation vectors in the world's frame, radians.
        source, target: ``(K,)`` the edges' ends.
    """

    vector: Tensor
    source: Tensor
    target: Tensor


@dataclass(frozen=True)
class NoiseShape:
    """Information matrices in the world's frame (N nodes): edge u→v has ``at_source[..., u] + at_target[..., v]``.

    Attributes:
        at_source, at_target: ``(3, 3, N)`` rad⁻², symmetric; a matrix's entries lie N apart, for sums over the nodes.
        scatter: covariances in the cameras' frames at either end, ``(C, 3, 3)`` rad²; None: nothing was estimated.
    """

    at_source: Tensor
    at_target: Tensor
    scatter: tuple[Tensor, Tensor] | None = None

    @classmethod
    def round(cls, num_nodes: int, device: torch.device) -> NoiseShape:
        """Every edge has the unit matrix."""
        half = torch.eye(3, dtype=torch.float64, device=device)[:, :, None].expand(3, 3, num_nodes) / 2
        return cls(half, half)


class ShapeEstimator:
    """Estimates noise shapes of the C components of a graph.

    Args:
        component: ``(N,)``.
        redundancy: ``(C,)`` how many edges each component has beyond a spanning tree.
    """

    def __init__(self, component: Tensor, redundancy: Tensor, priors: NoiseShapePriors) -> None:
        self._component, self._redundancy, self._priors = component, redundancy, priors

    def estimate(
        self, sample: ResidualSample, body_from_world: Tensor, before: NoiseShape, is_held: Tensor
    ) -> NoiseShape:
        """The shape that the residuals at given orientations have, every component for itself.

        Args:
            body_from_world: ``(N, 4)``.
            before: what was estimated a step ago.
            is_held: ``(C,)`` components that keep in their cameras' frames what was estimated a step ago.
        """
        matrix = _matrices(body_from_world)
        ends, starts = (sample.source, sample.target), before.scatter or (None, None)
        scatters = [matrix] * 2

        def estimate(number: int) -> None:
            end, start = ends[number], starts[number]
            at_end = matrix.flatten(0, 1).index_select(1, end).view(3, 3, -1)
            in_camera = (at_end * sample.vector).sum(dim=1)
            found = scatter(in_camera, self._component[end], len(self._redundancy), start, self._priors)
            scatters[number] = found if start is None else torch.where(is_held[:, None, None], start, found)

        for_each(estimate, (0, 1), threads_on(matrix.device))
        return self._placed((scatters[0], scatters[1]), matrix)

    def carried(self, shape: NoiseShape, body_from_world: Tensor) -> NoiseShape:
        """The same in the cameras' frames, where the cameras have turned to ``(N, 4)``."""
        return shape if shape.scatter is None else self._placed(shape.scatter, _matrices(body_from_world))

    def _placed(self, scatters: tuple[Tensor, Tensor], matrix: Tensor) -> NoiseShape:
        """Covariances in the cameras' frames → information in the world's, given body_from_world ``(3, 3, N)``."""
        at_ends = []
        for covariance in scatters:
            supported = _as_far_as_supported(covariance, self._redundancy, self._priors)
            information = torch.linalg.inv_ex(supported).inverse.permute(1, 2, 0) / 2
            if len(supported) > 1:
                information = information[:, :, self._component]
            turned = (information[:, :, None] * matrix).sum(dim=1)
            at_ends.append((matrix[:, :, None] * turned[:, None]).sum(dim=0))
        return NoiseShape(at_ends[0], at_ends[1], scatters)


def _matrices(body_from_world: Tensor) -> Tensor:
    """Orientations ``(N, 4)`` → ``(3, 3, N)``."""
    return rotations.to_matrix(body_from_world).permute(1, 2, 0).contiguous()


_PRIORS = NoiseShapePriors()


def scatter(
    vectors: Tensor,
    group: Tensor,
    num_groups: int,
    start: Tensor | None = None,
    priors: NoiseShapePriors = _PRIORS,
) -> Tensor:
    """Robust covariance ``(G, 3, 3)`` about zero of the vectors ``(3, K)`` of each group ``(K,)``, up to its scale.

    The maximum likelihood estimate for Student's t with one degree of freedom (Kent & Tyler 1991), sought from
    ``start``, an estimate from much the same vectors.
    """
    count = torch.bincount(group, minlength=num_groups).clamp(min=1)[:, None, None]
    unit = torch.eye(3, dtype=vectors.dtype, device=vectors.device)

    def second_moment(weight: Tensor) -> Tensor:
        if num_groups == 1:  # a matrix product adds up many times as fast
            total = ((weight * vectors) @ vectors.t()).flatten()[:, None]
        else:
            products = ((weight * vectors)[:, None] * vectors[None]).flatten(0, 1)
            total = products.new_zeros(9, num_groups).index_add_(1, group, products)
        moment: Tensor = priors.least_deviation**2 * unit + total.t().reshape(-1, 3, 3) / count
        return moment

    def squared_lengths(covariance: Tensor) -> Tensor:
        inverse = torch.linalg.inv_ex(covariance).inverse
        turned = (
            inverse[0] @ vectors if num_groups == 1 else (inverse.permute(1, 2, 0)[:, :, group] * vectors).sum(dim=1)
        )
        squares: Tensor = (vectors * turned).sum(dim=0)
        return squares

    if start is None:
        mean_square = second_moment(torch.ones_like(vectors[0])).diagonal(dim1=1, dim2=2).mean(dim=1)
        covariance, iterations = mean_square[:, None, None] * unit, priors.iterations
    else:
        covariance, iterations = start, priors.further_iterations
    for _ in range(iterations):
        covariance = second_moment(4 / (1 + squared_lengths(covariance)))
    return covariance


def _as_far_as_supported(covariance: Tensor, redundancy: Tensor, priors: NoiseShapePriors) -> Tensor:
    """The covariances ``(G, 3, 3)``, rounder the fewer residuals ``(G,)`` speak for them, and not too flat."""
    unit = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    mean_variance = covariance.diagonal(dim1=1, dim2=2).mean(dim=1)
    support = (redundancy / (redundancy + priors.round_residuals))[:, None, None]
    variance, axes = torch.linalg.eigh(support * covariance + (1 - support) * mean_variance[:, None, None] * unit)
    bounded = torch.maximum(variance, priors.least_ratio**2 * variance[:, -1:])
    return torch.matmul(axes, bounded[:, :, None] * axes.transpose(1, 2))
