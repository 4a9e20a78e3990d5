"""Who is compared on photo collections and scans, and the oracles, which know the outliers."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rotavg_ros.evaluation.common.cases import SFM, Case
from rotavg_ros.evaluation.common.contenders import Roster
from rotavg_ros.solver import solve
from rotavg_ros.view_graph import EdgeLabel

FULL_PIPELINE = "neurora"


def oracle(case: Case) -> Tensor:
    """Chatterjee & Govindu's ℓ1 → ℓ½ on the true inliers, from the truth."""
    return _told(case, "chatterjee")


def shaped_oracle(case: Case) -> Tensor:
    """Our refinement on the true inliers, from the truth, told the noise's shape by the residuals."""
    return _told(case, "neurora-without-both")


def _told(case: Case, method: str) -> Tensor:
    """A method that is told which edges are outliers, and begins at the truth."""
    label = torch.where(case.is_inlier, EdgeLabel.AUTOMATIC, EdgeLabel.REJECTED).to(case.graph.label)
    graph = replace(case.graph, label=label)
    return solve(graph, method=method, profile="sfm", device="cpu", warm_start=case.truth).body_from_world


ROSTER = Roster(
    SFM,
    peers=("colmap", "shonan"),
    references={"oracle": oracle, "oracle-shaped": shaped_oracle},
    # Shonan's matrices beyond this many edges take minutes.
    max_edges={"shonan": 150_000},
)
