"""The shape of a graph's noise: about which axes of the cameras' own frames measurements are exact.

Two views fix the rotation about the optical axis far better than pan and tilt, which trade off against the translation
(Daniilidis & Spetsakis 1997; in the Lund data's Sphinx, the errors about x, y and z are as 2.4 : 1.5 : 1). The shape is
estimated from residuals alone, without a prior. All cameras share it, but an edge's noise belongs to the frame of one
of its two ends. It is not known which one, since the direction in which an edge is stated is arbitrary. So each end has
a probability.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.medians import quantile_by_group
from rotavg_ros.solver.sfm.priors import NoiseShapePriors
from rotavg_ros.solver.sfm.symmetric_rows import turned


class ResidualSample(NamedTuple):
    """Residuals of K sampled edges.

    Attributes:
        vector: ``(3, K)`` rotation vectors in the world's frame, radians.
        source, target: ``(K,)`` the edges' ends.
    """

    vector: Tensor
    source: Tensor
    target: Tensor


@dataclass(frozen=True)
class NoiseShape:
    """Information matrices in the world's frame (N nodes).

    Attributes:
        information: ``(3, 3, N)`` rad⁻², symmetric, of an edge whose noise is in that node's frame; a matrix's entries
            lie N apart in memory, for sums over the nodes.
        covariance: ``(C, 3, 3)`` rad², in the cameras' frames; None: nothing was estimated.
    """

    information: Tensor
    covariance: Tensor | None = None

    @classmethod
    def round(cls, num_nodes: int, device: torch.device) -> NoiseShape:
        """The identity matrix for every node."""
        return cls(torch.eye(3, dtype=torch.float64, device=device)[:, :, None].expand(3, 3, num_nodes))


class ShapeEstimator:
    """Estimates noise shapes of the C components of a graph.

    Args:
        component: ``(N,)`` component of every node.
        redundancy: ``(C,)`` number of edges of each component beyond a spanning tree.
    """

    def __init__(self, component: Tensor, redundancy: Tensor, priors: NoiseShapePriors) -> None:
        self._component, self._redundancy, self._priors = component, redundancy, priors

    def estimate(
        self, sample: ResidualSample, body_from_world: Tensor, before: NoiseShape, is_held: Tensor
    ) -> NoiseShape:
        """The shape of the residuals at given orientations, estimated for each component independently.

        Args:
            body_from_world: ``(N, 4)``.
            before: the estimate of the previous step.
            is_held: ``(C,)`` components that keep the previous step's covariance in their cameras' frames.
        """
        matrix = _matrices(body_from_world)
        at_ends = (matrix.flatten(0, 1).index_select(1, end).view(3, 3, -1) for end in (sample.source, sample.target))
        in_cameras = [(at_end * sample.vector).sum(dim=1) for at_end in at_ends]
        group, start = self._component[sample.source], before.covariance
        typical = self._is_typical(sample.vector, group)
        in_cameras, group = [vector[:, typical] for vector in in_cameras], group[typical]
        found = scatter((in_cameras[0], in_cameras[1]), group, len(self._redundancy), start, self._priors)
        found = found if start is None else torch.where(is_held[:, None, None], start, found)
        return self._placed(found, matrix)

    def _is_typical(self, vector: Tensor, group: Tensor) -> Tensor:
        """Indices of the residuals ``(3, K)`` from which the shape is estimated: those no longer than most good ones.

        False edges often turn about one axis, where places look alike and cameras are upright. They would be taken for
        noise about that axis: a quarter of false edges is enough to swamp Student's t.
        """
        length = (vector * vector).sum(dim=0).sqrt()
        # The cost |r|^½ fits as many edges exactly as a spanning tree has; their residuals say nothing of their noise.
        nodes = torch.bincount(self._component, minlength=len(self._redundancy))
        share = 1 - (1 - self._priors.lower_share) * self._redundancy / (self._redundancy + nodes - 1).clamp(min=1)
        lower = quantile_by_group(length, group, share.clamp(0, 1))
        return (length <= self._priors.typical_lengths * lower[group]).nonzero()[:, 0]

    def carried(self, shape: NoiseShape, body_from_world: Tensor) -> NoiseShape:
        """The same shape in the cameras' frames, after the cameras have turned to ``(N, 4)``."""
        return shape if shape.covariance is None else self._placed(shape.covariance, _matrices(body_from_world))

    def _placed(self, covariance: Tensor, matrix: Tensor) -> NoiseShape:
        """Covariance in the cameras' frames → information in the world's, given body_from_world ``(3, 3, N)``."""
        supported = as_far_as_supported(covariance, self._redundancy, self._priors)
        information = torch.linalg.inv_ex(supported).inverse.permute(1, 2, 0)
        if len(supported) > 1:
            information = information[:, :, self._component]
        return NoiseShape(turned(information, matrix), covariance)


def share_of_first(first_square: Tensor, second_square: Tensor) -> Tensor:
    """Probability that noise belongs to the first of two frames, given its squared lengths in units of the noise there.

    Densities are normal, which tells the two frames apart more sharply than the heavy tails of :func:`scatter` would.
    """
    return torch.sigmoid((second_square - first_square) / 2)


def _matrices(body_from_world: Tensor) -> Tensor:
    """Orientations ``(N, 4)`` → ``(3, 3, N)``."""
    return rotations.to_matrix(body_from_world).permute(1, 2, 0).contiguous()


_PRIORS = NoiseShapePriors()


def scatter(
    vectors: tuple[Tensor, Tensor],
    group: Tensor,
    num_groups: int,
    start: Tensor | None = None,
    priors: NoiseShapePriors = _PRIORS,
) -> Tensor:
    """Robust covariance ``(G, 3, 3)`` about zero of the vectors of each group ``(K,)``, up to its scale.

    The maximum likelihood estimate for Student's t with one degree of freedom (Kent & Tyler 1991), iterated from
    ``start``, an estimate from nearly the same vectors. Every vector is given in two frames, each ``(3, K)``, and
    counts in each with the probability that noise belongs to that frame.
    """
    count = torch.bincount(group, minlength=num_groups).clamp(min=1)[:, None, None]
    both, groups = torch.cat(vectors, dim=1), group.repeat(2)
    unit = torch.eye(3, dtype=both.dtype, device=both.device)

    def second_moment(weight: Tensor) -> Tensor:
        if num_groups == 1:  # a matrix product is many times as fast
            total = ((weight * both) @ both.t()).flatten()[:, None]
        else:
            products = ((weight * both)[:, None] * both[None]).flatten(0, 1)
            total = products.new_zeros(9, num_groups).index_add_(1, groups, products)
        moment: Tensor = priors.least_deviation**2 * unit + total.t().reshape(-1, 3, 3) / count
        return moment

    def squared_lengths(covariance: Tensor) -> Tensor:
        inverse = torch.linalg.inv_ex(covariance).inverse
        turned = inverse[0] @ both if num_groups == 1 else (inverse.permute(1, 2, 0)[:, :, groups] * both).sum(dim=1)
        squares: Tensor = (both * turned).sum(dim=0)
        return squares

    if start is None:
        mean_square = second_moment(torch.full_like(both[0], 0.5)).diagonal(dim1=1, dim2=2).mean(dim=1)
        covariance, iterations = mean_square[:, None, None] * unit, priors.iterations
    else:
        covariance, iterations = start, priors.further_iterations
    for _ in range(iterations):
        squares = squared_lengths(covariance)
        first = share_of_first(*squares.chunk(2))
        covariance = second_moment(torch.cat((first, 1 - first)) * 4 / (1 + squares))
    return covariance


def as_far_as_supported(covariance: Tensor, redundancy: Tensor, priors: NoiseShapePriors) -> Tensor:
    """The covariances ``(G, 3, 3)``, shrunk towards round with fewer redundant edges ``(G,)``, and not too flat."""
    unit = torch.eye(3, dtype=covariance.dtype, device=covariance.device)
    mean_variance = covariance.diagonal(dim1=1, dim2=2).mean(dim=1)
    support = (redundancy / (redundancy + priors.round_residuals))[:, None, None]
    variance, axes = torch.linalg.eigh(support * covariance + (1 - support) * mean_variance[:, None, None] * unit)
    bounded = torch.maximum(variance, priors.least_ratio**2 * variance[:, -1:])
    return torch.matmul(axes, bounded[:, :, None] * axes.transpose(1, 2))
