"""The contenders on robots' graphs: odometry alone, least squares, the oracle, and all names in tables."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from torch import Tensor

from rotavg_ros.baselines.least_squares import least_squares
from rotavg_ros.baselines.start import start_orientations
from rotavg_ros.evaluation.common.cases import SLAM, Case
from rotavg_ros.evaluation.common.contenders import Roster
from rotavg_ros.solver.methods import SWITCHES, without

OURS, ORACLE, GNC = "neurora", "oracle", "gnc"


def odometry(case: Case) -> Tensor:
    """Orientations along the odometry; closures only where nothing else connects."""
    return start_orientations(case.graph, None)[0]


def all_edges(case: Case) -> Tensor:
    """Least squares on all edges."""
    return least_squares(case.graph, np.ones(case.graph.num_edges, dtype=bool))


def oracle(case: Case) -> Tensor:
    """Least squares on the true inliers, with true precisions where they are known.

    Edges that are left out, slips among them, count only where nothing else connects.
    """
    graph = case.graph if case.true_precision is None else replace(case.graph, precision=case.true_precision)
    return least_squares(graph, case.is_inlier.numpy())


ROSTER = Roster(
    SLAM,
    peers=(GNC, "isam2", "isam2-cauchy", "isam2-geman-mcclure", "open3d", "colmap"),
    references={"odometry": odometry, "least-squares": all_edges, ORACLE: oracle},
    # Its matrices are dense: half a gigabyte each there.
    max_edges={"open3d": 2000},
)
ROWS: dict[str, str] = {
    OURS: "**ours** (NeuRoRA for SLAM)",
    "cleannet-spt": "· without the search",
    "spt": "· tree alone",
    **{without(name): f"· without {name}" for name in SWITCHES},
    "gnc": "GNC (GTSAM), told that odometry is right",
    "isam2": "iSAM2 with Huber's loss (GTSAM), incremental",
    "isam2-cauchy": "iSAM2 with Cauchy's loss (GTSAM), incremental",
    "isam2-geman-mcclure": "iSAM2 with Geman–McClure's loss (GTSAM), incremental",
    "open3d": "line process (Open3D), told that odometry is right",
    "colmap": "COLMAP's rotation averaging",
    "chatterjee": "Chatterjee & Govindu (ℓ1 → ℓ½) from odometry",
    "least-squares": "least squares on all edges",
    "odometry": "odometry alone",
    "oracle": "oracle: least squares on the true inliers",
}
