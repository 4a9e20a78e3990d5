"""Which edges plain least squares may have."""

from __future__ import annotations

import numpy as np

from rotavg_ros.datasets.files.corrected_graph import is_told


def test_closures_of_right_rotation_stay_and_so_does_odometry_that_slipped() -> None:
    """Sound odometry, a slip, a good closure, a wrong place, a false rotation, a closure that waits."""
    is_odometry = np.array([True, True, False, False, False, False])
    outlier = np.array([False, True, False, True, True, False])
    rotation_score = np.array([0.0, 0.9, 0.1, 0.2, 0.8, 0.1])
    precision = np.array([[1e4, 1e2], [3.0, 1e2], [1e3, 10.0], [40.0, 1e-6], [1e-3, 1e-7], [0.0, 0.0]])
    kept = is_told(outlier, is_odometry, (rotation_score, precision))
    assert kept.tolist() == [True, True, True, True, False, False]
    assert (is_told(outlier, is_odometry, None) == ~outlier).all()
