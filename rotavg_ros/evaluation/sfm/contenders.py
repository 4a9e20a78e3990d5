"""The contenders on photo collections and scans, and the oracles, which know the outliers."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rotavg_ros.baselines import residual_score
from rotavg_ros.baselines.most_likely import most_likely
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.cases import SFM, Case
from rotavg_ros.evaluation.common.contenders import OwnContender, Roster
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import EdgeLabel

FULL_PIPELINE = "neurora"


def oracle(case: Case) -> Tensor | None:
    """Chatterjee & Govindu's ℓ1 → ℓ½ on the true inliers, from the truth; None: unknown."""
    return _told(case, "chatterjee")


def shaped_oracle(case: Case) -> Tensor | None:
    """The same with our refinement; the noise's shape is estimated from the residuals."""
    return _told(case, "neurora-without-both")


def _told(case: Case, method: str) -> Tensor | None:
    """A method that is told which edges are outliers, and begins at the truth."""
    if not bool(case.truth.isfinite().all()):
        return None
    label = torch.where(case.is_inlier, EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED).to(case.graph.label)
    graph = replace(case.graph, label=label)
    return solve(graph, method=method, profile="sfm", device="cpu", warm_start=case.truth).body_from_world


def told_covariances(case: Case) -> Answer | None:
    """Least squares from the truth, weighted by the covariances of the edges' noise; None: unknown."""
    if case.noise_covariance is None:
        return None
    clock = Clock()
    with clock.running():
        orientations = most_likely(case.graph, case.noise_covariance.of_edges(), case.truth)
    score = residual_score(case.graph, orientations, case.family.outlier_angle)
    return Answer(orientations, clock.seconds, clock.cpu_seconds, score)


ROSTER = Roster(
    SFM,
    peers=("colmap", "shonan"),
    references={"oracle": oracle, "oracle-shaped": shaped_oracle},
    # Shonan's matrices beyond this many edges take minutes.
    max_edges={"shonan": 150_000},
    own={"oracle-covariances": OwnContender(told_covariances)},
)
