"""The numbers of the SfM refinement, each with its unit, its source, and how much the answer depends on it.

"Insensitive" means: half and twice the value change the mean error by less than 1 % on the tuning graphs of
``docs/diary/sfm-refinement.md``, which lists what each change gives.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class NoiseShapePriors:
    """How the noise's covariance in the cameras' frames is estimated (``noise_shape.py``).

    Attributes:
        iterations, further_iterations: of the scatter's fixed point, from nothing and from the last step's scatter.
        least_ratio: standard deviations: no axis is believed to be more exact than this share of the least exact one.
        least_deviation: radians, added to every axis: keeps the covariance of exact measurements invertible.
        round_residuals: edges beyond a spanning tree that weigh as much as the assumption that noise is round.
    """

    iterations: int = 10
    further_iterations: int = 3
    least_ratio: float = 0.1
    least_deviation: float = float(np.radians(1e-4))
    round_residuals: float = 20.0


@dataclass(frozen=True)
class RefinementPriors:
    """How the refinement weighs edges and when it ends (``sfm_refinement.py``).

    Attributes:
        max_steps: bound on all steps.
        max_coarse_steps: bound on those of the coarse ones.
        least_shaped_steps: of few steps, so many at least are shaped.
        coarse_smoothing: radians: shorter residuals weigh as this one in coarse steps.
        coarse_settled: coarse steps end once they turn cameras by less than this share of the typical residual.
        relaxation: how many times its length a shaped step is taken; any factor below 2 lowers the cost.
        stretched: standard errors: of steps shorter than this.
        held: standard errors: the noise is not estimated again after a shaped step of less than this.
        converged: standard errors: a shaped step of less than this is the last.
        converged_angle: radians: so is a step that turns no camera by more.
        step_tolerance: share of a step that conjugate gradients may leave to the next step.
        least_angle: radians: the same absolutely.
        least_square: variances of the noise: numerical floor of a residual's expected square.
        least_prior: of an edge's weight: keeps nodes attached of which all edges are rejected.
        coarse_noise: radians: where residuals are typically larger, single precision is exact enough.
        least_residual: radians: numerical floor of the typical residual.
        well_knit_degree: edges per node from which on conjugate gradients need no factorisation.
        max_sample: edges of a component that tell its noise.
    """

    max_steps: int = 30
    max_coarse_steps: int = 8
    least_shaped_steps: int = 3
    coarse_smoothing: float = float(np.radians(1.0))
    coarse_settled: float = 0.2
    relaxation: float = 1.5
    stretched: float = 1.0
    held: float = 0.3
    converged: float = 0.05
    converged_angle: float = float(np.radians(0.001))
    step_tolerance: float = 0.03
    least_angle: float = 1e-6
    least_square: float = 1e-6
    least_prior: float = 1e-6
    coarse_noise: float = 1e-3
    least_residual: float = float(np.radians(0.001))
    well_knit_degree: float = 12.0
    max_sample: int = 8_000
    shape: NoiseShapePriors = NoiseShapePriors()
