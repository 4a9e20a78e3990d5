"""Every statistical or tuned number of the paper's stages, in one place."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class NeuroraNumbers:
    """Numbers of CleanNet's verdict, the tree, FineNet's features and the score by residuals.

    Attributes:
        outlier_angle: rad; an edge whose noise exceeds it is an outlier. The paper's label (§5.1).
        outlier_threshold: probability; an edge with more is no inlier. The paper's ε, uncritical in 0.35–0.8.
        edge_cost: of every edge in the tree; sets the unit of costs. The authors' released code.
        outlier_cost: what a certain outlier costs more, in that unit. Between the released code's 1.0 and the paper's
            tree, which has no outliers at all.
        fringe_cost: edges; divided by the degree of that end which has the lower one, it is what an edge costs besides,
            since CleanNet rectifies poorly where few other edges check an edge.
        min_residual: half an angle in rad; the median residual that FineNet's features are in units of is at least
            this, so that exact measurements do not divide by zero.
        max_logit: CleanNet's log-odds are cut there before FineNet sees them.
        logit_unit, log_degree_unit: what FineNet's features of these are divided by, so that they are of order one.
            Part of the trained network: another value needs other weights.
        score_scale: by how many times the uncertainty of the ends a residual has to pass the outlier angle for the
            log-odds of an outlier to rise by one. Fitted: `python -m rotavg_ros.training.score_fit`.
        min_uncertainty: rad; the uncertainty of the ends is at least this, so that exact measurements have scores.
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
