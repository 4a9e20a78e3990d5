"""The axes about which each edge states to be exact, believed as far as residuals confirm them.

A stated information matrix has a size, one over the mean variance, and a shape, its covariance Σ_e scaled to a mean
variance of one. :mod:`rotavg_ros.solver.sfm.stated.precision` handles the size. An edge's noise is assumed to have the
shape

    Σ_e^β, scaled to a mean variance of one,     0 ≤ β ≤ 1,

in the target's frame. T_e is its inverse square root. T_e r has the same shape C for all edges, in the cameras' frames;
C is estimated for each β as in the refinement (:mod:`rotavg_ros.solver.sfm.noise_shape`). So stated shapes are credited
for what they say of single edges, not for what all edges have in common. The density of residuals is Student's t with
one degree of freedom, in either end's frame with probability one half:

    log p_e = log det T_e − ½ log det C + log Σ_k ½ (1 + y_kᵀ C⁻¹ y_k)⁻²,     y_k = R_k T_e r_e / √ρ_e

β is its posterior mean. Its prior puts a high probability on 0. Residuals may favour β > 0 although no statement is
true of its own edge, since T also says that the noise of all edges is in the targets' frames. So the largest gain in
likelihood that is reached with statements exchanged between edges is subtracted.
"""

from __future__ import annotations

from dataclasses import replace
from math import log
from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.canonical_form import evenly_spread
from rotavg_ros.solver.sfm.noise_shape import as_far_as_supported, scatter
from rotavg_ros.solver.sfm.priors import NoiseShapePriors, PrecisionPriors
from rotavg_ros.solver.sfm.stated.precision import PRECISION_PRIORS, Residuals, is_telling, posterior_mean

# Iterations of the common shape's fixed point, from scratch and from the previous β. No β must gain from incomplete
# convergence: with 10 and 3, as in the refinement, the Sphinx's likelihood gains 10 nats.
_ITERATIONS, _FURTHER_ITERATIONS = 40, 10


class FramedResiduals(NamedTuple):
    """Residuals of M edges in C components.

    Attributes:
        vector: ``(M, 3)`` rotation vectors in the targets' frames, rad, in units of √ρ.
        source_from_target: ``(M, 3, 3)`` takes them to the sources' frames.
        component: ``(M,)`` component of every edge.
        redundancy: ``(C,)`` number of edges of each component beyond a spanning tree.
    """

    vector: Tensor
    source_from_target: Tensor
    component: Tensor
    redundancy: Tensor

    @property
    def lengths(self) -> Residuals:
        """The residuals without their axes."""
        return Residuals(self.vector.norm(dim=1), self.component, self.redundancy)

    def select(self, edges: Tensor) -> FramedResiduals:
        """Some of the edges, by their indices."""
        vector, turn, component = (column[edges] for column in self[:3])
        return FramedResiduals(vector, turn, component, self.redundancy)


class _Shapes(NamedTuple):
    """Shapes of M edges: axes ``(M, 3, 3)`` in columns, and logarithms of the variances along them ``(M, 3)``."""

    axes: Tensor
    log_variance: Tensor

    @classmethod
    def of(cls, information: Tensor, is_known: Tensor, least_ratio: float) -> _Shapes:
        """From information ``(M, 3, 3)``; round where it is not known."""
        unit = torch.eye(3, dtype=information.dtype, device=information.device)
        value, axes = torch.linalg.eigh(torch.where(is_known[:, None, None], information, unit))
        # The first axis is the least exact one. A matrix that is not positive definite counts as stating nothing.
        share = torch.where(value[:, :1] > 0, value / value[:, :1], 1.0)
        return cls(axes, -share.log().clamp(max=-2 * log(least_ratio)))

    def inverse_deviation(self, exponent: Tensor) -> Tensor:
        """One over the standard deviations along the axes ``(M, 3)``, given β ``(M,)`` or one β for all."""
        variance = (exponent[..., None] * self.log_variance).exp()
        return (variance / variance.mean(dim=1, keepdim=True)).rsqrt()

    def units(self, inverse_deviation: Tensor) -> Tensor:
        """T ``(M, 3, 3)``."""
        return (self.axes * inverse_deviation[:, None]) @ self.axes.mT


def believed_units(
    information: Tensor,
    residuals: FramedResiduals,
    shape: NoiseShapePriors,
    priors: PrecisionPriors = PRECISION_PRIORS,
) -> Tensor | None:
    """T of every edge, in its target's frame, ``(3, 3, M)``, the identity where β is 0; None if it is 0 everywhere.

    Args:
        information: ``(M, 3, 3)`` in the targets' frames, of any scale; NaN where unknown, which counts as round.
        shape: how the common shape is estimated; its ``least_ratio`` bounds how exact an axis is believed to be.
    """
    is_known = information.isfinite().all(dim=2).all(dim=1)
    if not bool(is_known.any()):
        return None
    shapes = _Shapes.of(information, is_known, shape.least_ratio)
    known = (is_known & is_telling(residuals.lengths, priors)).nonzero().squeeze(1)
    if len(known) == 0:
        return None
    chosen = known[evenly_spread(residuals.component[known], len(residuals.redundancy), priors.max_sample)]
    sampled = _Shapes(shapes.axes[chosen], shapes.log_variance[chosen])
    edges = torch.bincount(residuals.component, minlength=len(residuals.redundancy)).clamp(min=1)
    worth = residuals.redundancy.clamp(min=0) / edges
    exponent = _exponents(sampled, residuals.select(chosen), worth, shape, priors)
    exponent = torch.where(exponent < priors.least_exponent, 0.0, exponent)
    if not bool((exponent > 0).any()):
        return None
    of_edge = exponent[residuals.component]
    units = shapes.units(shapes.inverse_deviation(of_edge))
    unit = torch.eye(3, dtype=units.dtype, device=units.device)
    return torch.where((of_edge > 0)[:, None, None], units, unit).permute(1, 2, 0).contiguous()


def _exponents(
    shapes: _Shapes, residuals: FramedResiduals, worth: Tensor, shape: NoiseShapePriors, priors: PrecisionPriors
) -> Tensor:
    """Posterior mean of β, ``(C,)``; 0 where stated shapes are nearly round.

    Args:
        worth: ``(C,)`` weight of each residual.
    """
    group, count = residuals.component, len(residuals.redundancy)
    number = torch.bincount(group, minlength=count)
    exponent = torch.linspace(0.0, 1.0, priors.num_exponents, dtype=torch.float64, device=group.device)
    others = _of_others(group, number)
    own, of_others = (
        worth * _log_likelihoods(stated, residuals, exponent, shape)
        for stated in (shapes, _Shapes(shapes.axes[others], shapes.log_variance[others]))
    )
    gain = own - own[0]
    gain[1:] -= (of_others - of_others[0]).amax(dim=0)  # the maximum is at least 0
    mean_exponent = posterior_mean(exponent, gain, priors)
    variance = shapes.log_variance.var(dim=1, correction=0)
    spread = (variance.new_zeros(count).index_add_(0, group, variance) / number.clamp(min=1)).sqrt()
    return torch.where(spread < priors.least_spread, 0.0, mean_exponent)


def _of_others(group: Tensor, number: Tensor) -> Tensor:
    """For each edge another one of its group, half of the group away, ``(K,)``.

    Args:
        group: ``(K,)`` ascending.
        number: ``(C,)`` of edges in each group.
    """
    first = (number.cumsum(0) - number)[group]
    place = torch.arange(len(group), device=group.device) - first
    size = number[group]
    return first + (place + size.div(2, rounding_mode="floor")) % size


def _log_likelihoods(shapes: _Shapes, residuals: FramedResiduals, exponents: Tensor, shape: NoiseShapePriors) -> Tensor:
    """Σ log p_e of each component for each β, ``(K, C)``, up to a constant."""
    group, redundancy = residuals.component, residuals.redundancy
    shape = replace(shape, iterations=_ITERATIONS, further_iterations=_FURTHER_ITERATIONS)
    start, rows = None, []
    for exponent in exponents:
        inverse_deviation = shapes.inverse_deviation(exponent)
        at_target = shapes.units(inverse_deviation) @ residuals.vector[:, :, None]
        at_source = residuals.source_from_target @ at_target
        vectors = (at_source.squeeze(2).t().contiguous(), at_target.squeeze(2).t().contiguous())
        start = scatter(vectors, group, len(redundancy), start, shape)  # nearly the same for the next β
        covariance = as_far_as_supported(start, redundancy, shape)
        inverse = torch.linalg.inv_ex(covariance).inverse.permute(1, 2, 0)[:, :, group]
        squares = [((inverse * vector).sum(dim=1) * vector).sum(dim=0) for vector in vectors]
        at_either = torch.logsumexp(torch.stack([-2 * square.log1p() for square in squares]), dim=0)
        of_edge = inverse_deviation.log().sum(dim=1) - torch.logdet(covariance)[group] / 2 + at_either
        rows.append(of_edge.new_zeros(len(redundancy)).index_add_(0, group, of_edge))
    return torch.stack(rows)
