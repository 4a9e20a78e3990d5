"""Every statistical or tuned number of the paper's stages, in one place.

How much the answer depends on a number was measured by halving and doubling it on twelve graphs of three synthetic
recipes, for which no results are reported. "v2" is the change of the mean error of ``neurora-v2``, which ends with
FineNet. The change for the default, which ends with the refinement, is at most 0.3 % unless stated otherwise.
"""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class NeuroraNumbers:
    """Numbers of CleanNet's verdict, the tree, FineNet's features and the score by residuals.

    Attributes:
        outlier_angle: rad; an edge whose noise exceeds it is an outlier. The paper's label (§5.1).
        outlier_threshold: probability; an edge with more is not an inlier. The paper's ε, uncritical in 0.35–0.8.
            v2: +3.5 % at half, −1.6 % at 0.99.
        edge_cost: of every edge in the tree; sets the unit of costs. The authors' released code. v2: 0.1 %.
        outlier_cost: additional cost of a certain outlier, in that unit. Between the 1.0 of the released code and the
            paper's tree, which has no outliers at all. v2: 0.1 %.
        fringe_cost: edges; divided by the lower degree of an edge's two ends, it is a further cost of the edge, since
            CleanNet rectifies poorly where few other edges check an edge. v2: below 0.1 %.
        min_residual: half an angle in rad; lower bound of the median residual, the unit of FineNet's features, so that
            exact measurements do not divide by zero. v2: nothing.
        max_logit: CleanNet's log-odds are clamped to ± this before FineNet sees them. v2: +3.2 % and +1.5 %.
        logit_unit, log_degree_unit: divisors of FineNet's features of these, which make them of order one. Part of the
            trained network: another value needs other weights. Without those, v2: +4 to +22 %, default up to 1.1 %.
        score_scale: dimensionless. score = σ((|r| − outlier_angle) / (score_scale · u)) with the logistic function σ
            and the uncertainty u of the ends, rad. Fitted: `python -m rotavg_ros.training.score_fit`. Orientations
            do not depend on it; the calibration error is 0.003 at half, 0.004 as it is, 0.017 at twice the value.
        min_uncertainty: rad; lower bound of the ends' uncertainty, so that exact measurements have scores. Nothing else
            depends on it.
    """

    outlier_angle: float = math.radians(20.0)
    outlier_threshold: float = 0.75
    edge_cost: float = 0.1
    outlier_cost: float = 1.0
    fringe_cost: float = 5.0
    min_residual: float = 1e-4
    max_logit: float = 12.0
    logit_unit: float = 4.0
    log_degree_unit: float = 4.0
    score_scale: float = 0.376
    min_uncertainty: float = math.radians(0.01)


NUMBERS = NeuroraNumbers()
