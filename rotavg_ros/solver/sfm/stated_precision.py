"""How far the precisions that edges state are believed: exactly as far as their residuals bear them out.

The scale of what a file states is often unknown, and its differences from edge to edge may mean nothing. So an edge's
noise is assumed to have the variance of a typical edge's times

    ρ_e = (typical precision / stated precision) ^ α,        0 ≤ α ≤ 1.

α is the mean over its posterior. Beforehand it is 0 with a high probability, so that nothing is believed unless the
residuals speak for it. Their density is Student's t with one degree of freedom in three dimensions and the scale
s √ρ_e, which outliers do not swamp; s is the likeliest for each α. The residuals are those of an answer that took all
edges to be alike.

In the refinement an edge's residual then counts in units of √ρ_e. For the costs |r| and |r|^½ that is a weight of
ρ^(−1/2) and ρ^(−1/4).
"""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.solver.sfm.priors import PrecisionPriors

PRECISION_PRIORS = PrecisionPriors()
# Fixed-point steps to the likeliest scale; what is left after so many is below 1 %.
_SCALE_STEPS = 30


def relative_variance(
    precision: Tensor, angle: Tensor, redundancy: float, priors: PrecisionPriors = PRECISION_PRIORS
) -> Tensor | None:
    """Variance of every edge's noise in units of a typical edge's, ``(M,)``; None where all are alike.

    Args:
        precision: ``(M,)`` rad⁻², of any scale; NaN where unknown, which counts as typical.
        angle: ``(M,)`` rad, of the residuals.
        redundancy: number of edges beyond a spanning forest: so many residuals are worth something.
    """
    is_known = precision.isfinite() & (precision > 0)
    if not bool(is_known.any()) or redundancy <= 0:
        return None
    log_precision = torch.where(is_known, precision, 1.0).log()
    log_ratio = torch.where(is_known, log_precision[is_known].median() - log_precision, 0.0)
    log_ratio = log_ratio.clamp(-priors.max_log_ratio, priors.max_log_ratio)
    if float(log_ratio.std()) < priors.least_spread:
        return None
    exponent = _exponent(log_ratio[is_known].double(), angle[is_known].double(), redundancy / len(angle), priors)
    return None if exponent < priors.least_exponent else (exponent * log_ratio).exp()


def _exponent(log_ratio: Tensor, angle: Tensor, worth: float, priors: PrecisionPriors) -> float:
    """Mean of α over its posterior.

    Args:
        log_ratio: ``(K,)`` of typical to stated precision.
        angle: ``(K,)`` rad.
        worth: how many independent residuals each is.
    """
    chosen = slice(None, None, 1 + len(angle) // priors.max_sample)
    log_ratio, square = log_ratio[chosen], (angle * angle)[chosen].clamp(min=priors.least_angle**2)
    exponent = torch.linspace(0.0, 1.0, priors.num_exponents, dtype=square.dtype, device=square.device)
    scaled = square * (-exponent[:, None] * log_ratio).exp()  # r²/ρ, a row each
    scale = scaled.median(dim=1, keepdim=True).values
    for _ in range(_SCALE_STEPS):
        # Kent & Tyler (1991): the derivative of the likelihood by s² vanishes at this fixed point.
        scale = (4 / 3) * (scaled / (1 + scaled / scale)).mean(dim=1, keepdim=True)
    log_likelihood = (-1.5 * (scale.log() + exponent[:, None] * log_ratio) - 2 * (scaled / scale).log1p()).sum(dim=1)
    prior = torch.full_like(exponent, (1 - priors.worthless) / (len(exponent) - 1))
    prior[0] = priors.worthless
    posterior = torch.softmax(worth * log_likelihood + prior.log(), dim=0)
    return float(posterior @ exponent)
