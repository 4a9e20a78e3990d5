"""A bias that turns the map more than once around: no closure agrees with odometry, and none may seem right."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros import EdgeKind, ViewGraph, solve
from rotavg_ros.metrics.orientations import orientation_errors

KEYFRAMES, BIAS_DEG = 500, 1.0


@pytest.mark.parametrize(("seed", "tilt"), [(6, 0.0), (0, 0.2)])
def test_few_closures_and_a_large_bias(seed: int, tilt: float) -> None:
    """Ten right closures and no false one; all ten had been flagged, and orientations were 74° off."""
    rng = np.random.default_rng(seed)
    along = np.arange(KEYFRAMES)
    yaw = np.cumsum(rng.normal(0, 0.12, KEYFRAMES))
    turn = Rotation.from_euler("ZYX", np.c_[yaw, tilt * np.sin(along / 9), tilt * np.cos(along / 7)])
    loops = np.sort(rng.integers(0, KEYFRAMES, (12, 2)), axis=1)
    loops = loops[loops[:, 1] - loops[:, 0] > 30]
    source, target = np.r_[along[:-1], loops[:, 0]], np.r_[along[1:], loops[:, 1]]
    odometry = np.arange(len(source)) < KEYFRAMES - 1
    error = rng.normal(size=(len(source), 3)) * np.radians(np.where(odometry, 0.16, 1.5))[:, None]
    error[odometry, 2] += np.radians(BIAS_DEG)
    if tilt == 0:
        error[:, :2] = 0
    graph = ViewGraph.create(
        source,
        target,
        source_from_target=(turn[source].inv() * turn[target] * Rotation.from_rotvec(error)).as_quat(),
        kind=np.where(odometry, EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE),
    )
    solution = solve(graph)
    truth = torch.from_numpy(turn.inv().as_quat())
    errors = orientation_errors(solution.body_from_world, truth, graph.components())
    assert np.degrees(float(errors.mean())) < 3
    assert (solution.outlier_score < 0.5).all()
