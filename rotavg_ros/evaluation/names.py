"""Names that the options of ``rotavg evaluate`` and ``rotavg benchmark`` choose from.

They are listed here without the code that they name, so that ``--help`` needs no torch; a test compares the two.
"""

from __future__ import annotations

SYNTHETIC_RECIPES = ("released", "released-spatial", "paper")
ROBUSTNESS_SETTINGS = (
    "cameras-250",
    "cameras-5000",
    "cameras-10000",
    "cameras-25000",
    "pairs-2.5",
    "pairs-25",
    "noise-10",
    "noise-30",
    "in-space",
    "planar",
)
RGBD_SETS = ("scannet_fgr", "scannet_super4pcs", "redwood_fgr", "redwood_super4pcs")
SLAM_SUITES = ("recorded", "stress", "poses")
SLAM_GRAPHS = (
    "B25b_0.000",
    "B25b_0.250",
    "B25b_0.500",
    "intel",
    "CSAIL",
    "FR079",
    "manhattan",
    "parking-garage",
    "sphere2500",
    "KITTI_00",
    "KITTI_02",
    "KITTI_05",
    "KITTI_06",
)
# Shares of random false closures.
SLAM_SHARES = (0.0, 0.1, 0.3, 0.5, 0.8)
BENCHMARK_FAMILIES = ("recipe", "sfm-sparse", "slam", "sfm-dense")
BENCHMARK_CONTENDERS = ("neurora", "neurora-v1", "neurora-cuda", "colmap", "shonan", "gnc")
