"""Who is compared on photo collections and scans, and the oracles, which know the outliers."""

from __future__ import annotations

import torch
from torch import Tensor

from rotavg_ros.evaluation.common.cases import SFM, Case
from rotavg_ros.evaluation.common.contenders import Roster
from rotavg_ros.solver import sfm_refinement
from rotavg_ros.solver.refinement import refine
from rotavg_ros.solver.spanning_tree import shortest_path_forest

FULL_PIPELINE = "neurora"
# Until it moves no more: a few steps would remember the truth that they start from.
_STEPS = 50


def oracle(case: Case) -> Tensor:
    """Our refinement from the truth to convergence, every true inlier weighing one and every outlier nothing."""
    return refine(case.graph, case.truth, case.is_inlier.double(), shortest_path_forest(case.graph).roots, _STEPS)


def shaped_oracle(case: Case) -> Tensor:
    """The same, told the noise's shape by the residuals."""
    roots = torch.from_numpy(shortest_path_forest(case.graph).roots)
    weight = case.is_inlier.double()
    return sfm_refinement.refine(case.graph, case.truth, roots, _STEPS, prior_weight=weight, shaped_steps=_STEPS)


ROSTER = Roster(
    SFM,
    peers=("colmap", "shonan"),
    references={"oracle": oracle, "oracle-shaped": shaped_oracle},
    # Shonan's matrices beyond this many edges take minutes.
    max_edges={"shonan": 150_000},
)
