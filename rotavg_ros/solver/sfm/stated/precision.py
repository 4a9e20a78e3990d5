"""How far the precisions that edges state are believed: exactly as far as their residuals confirm them.

The scale of the precisions in a file is often unknown, and differences between edges may mean nothing. So an edge's
noise is assumed to have the variance of a typical edge times

    ρ_e = (typical precision / stated precision) ^ α,        0 ≤ α ≤ 1.

α is its posterior mean. Its prior puts a high probability on 0, so that nothing is believed without evidence from the
residuals. Their density is Student's t with one degree of freedom in three dimensions and the scale s √ρ_e, which is
robust to outliers; s is the maximum-likelihood value for each α. The residuals are those of an answer that treats all
edges alike. If edges are few, minimising |r|^½ fits as many edges exactly as there are nodes. The residuals of these
edges say nothing of their noise and are left out.

In the refinement an edge's residual then counts in units of √ρ_e. For the costs |r| and |r|^½ this is a weight of
ρ^(−1/2) and ρ^(−1/4).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.canonical_form import evenly_spread
from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.sfm.priors import PrecisionPriors
from rotavg_ros.view_graph import ViewGraph, mean_precision

PRECISION_PRIORS = PrecisionPriors()
# Number of fixed-point steps to the likeliest scale; the remaining error is below 1 %.
_SCALE_STEPS = 30


class Residuals(NamedTuple):
    """Residuals of M edges in C components.

    Attributes:
        angle: ``(M,)`` rad.
        component: ``(M,)`` component of every edge.
        redundancy: ``(C,)`` number of edges of each component beyond a spanning tree, its effective residuals.
    """

    angle: Tensor
    component: Tensor
    redundancy: Tensor


def stated_sizes(graph: ViewGraph) -> Tensor:
    """One over the mean variance stated by each edge, ``(M,)`` rad⁻² of any scale; NaN: nothing is stated."""
    if graph.information is None:
        return graph.precision
    size = mean_precision(graph.information)
    return torch.where(size.isfinite(), size, graph.precision)


def relative_variance(
    precision: Tensor, residuals: Residuals, priors: PrecisionPriors = PRECISION_PRIORS
) -> Tensor | None:
    """Variance of every edge's noise in units of a typical edge of its component, ``(M,)``; None if all are alike.

    Args:
        precision: ``(M,)`` rad⁻², of any scale; NaN where unknown, which counts as typical.
    """
    is_known = precision.isfinite() & (precision > 0)
    if not bool(is_known.any()):
        return None
    group, count = residuals.component, len(residuals.redundancy)
    log_precision = torch.where(is_known, precision, 1.0).double().log()
    typical = median_by_group(log_precision[is_known], group[is_known], count)
    log_ratio = torch.where(is_known, typical[group] - log_precision, 0.0)
    log_ratio = log_ratio.clamp(-priors.max_log_ratio, priors.max_log_ratio)
    exponent = _exponents(log_ratio, is_known, residuals, priors)
    exponent = torch.where(exponent < priors.least_exponent, 0.0, exponent)
    return (exponent[group] * log_ratio).exp() if bool((exponent > 0).any()) else None


def is_telling(residuals: Residuals, priors: PrecisionPriors) -> Tensor:
    """Edges that the answer does not fit exactly, ``(M,)`` bool: residuals not negligible beside typical ones."""
    typical = median_by_group(residuals.angle, residuals.component, len(residuals.redundancy))
    return residuals.angle >= priors.least_residual * typical[residuals.component]


def _exponents(log_ratio: Tensor, is_known: Tensor, residuals: Residuals, priors: PrecisionPriors) -> Tensor:
    """Posterior mean of α, ``(C,)``; 0 where stated precisions hardly differ.

    Args:
        log_ratio: ``(M,)`` log ratio of typical to stated precision.
        is_known: ``(M,)`` bool.
    """
    count = len(residuals.redundancy)
    edges = torch.bincount(residuals.component, minlength=count)
    known = (is_known & is_telling(residuals, priors)).nonzero().squeeze(1)
    chosen = known[evenly_spread(residuals.component[known], count, priors.max_sample)]
    log_ratio, group = log_ratio[chosen], residuals.component[chosen]
    number = torch.bincount(group, minlength=count).clamp(min=1)
    square = residuals.angle[chosen].double().clamp(min=priors.least_angle) ** 2
    exponent = torch.linspace(0.0, 1.0, priors.num_exponents, dtype=square.dtype, device=square.device)
    scaled = square * (-exponent[:, None] * log_ratio).exp()  # r²/ρ, a row for each α

    def sums(rows: Tensor) -> Tensor:
        return rows.new_zeros(len(rows), count).index_add_(1, group, rows)

    scale = median_by_group(square, group, count).expand(len(exponent), count).nan_to_num(nan=1.0)
    for _ in range(_SCALE_STEPS):
        # Kent & Tyler (1991): the derivative of the likelihood with respect to s² vanishes at this fixed point.
        scale = (4 / 3) * sums(scaled / (1 + scaled / scale[:, group])) / number
        scale = scale.clamp(min=priors.least_angle**2)
    log_likelihood = sums(
        -1.5 * (scale[:, group].log() + exponent[:, None] * log_ratio) - 2 * (scaled / scale[:, group]).log1p()
    )
    worth = residuals.redundancy.clamp(min=0) / edges.clamp(min=1)
    mean_exponent = posterior_mean(exponent, worth * log_likelihood, priors)
    mean = sums(log_ratio[None]) / number
    spread = (sums(log_ratio[None] ** 2) / number - mean**2).clamp(min=0).sqrt()[0]
    return torch.where(spread < priors.least_spread, 0.0, mean_exponent)


def posterior_mean(exponent: Tensor, log_likelihood: Tensor, priors: PrecisionPriors) -> Tensor:
    """Posterior mean of an exponent, ``(C,)``, with a prior that favours 0.

    Args:
        exponent: ``(K,)`` from 0 to 1.
        log_likelihood: ``(K, C)`` log-likelihood of each.
    """
    prior = torch.full_like(exponent, (1 - priors.worthless) / (len(exponent) - 1))
    prior[0] = priors.worthless
    return exponent @ torch.softmax(log_likelihood + prior.log()[:, None], dim=0)
