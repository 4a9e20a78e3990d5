"""Warnings name keyframes as their senders know them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind

LAP, STEPS, SLIP, FIRST_ID = 30, 150, 62, 5000


def test_a_slip_is_between_keyframes_that_can_be_looked_up() -> None:
    """Two robots of five rounds: the second is off by a radian once, as closures over one round, two and three tell."""
    turn = 2 * np.pi / LAP
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges"))
    rng = np.random.default_rng(0)

    def add(robot: str, source: int, target: int, angle: float, kind: EdgeKind) -> None:
        ends = (KeyframeReference(robot, keyframe_id=FIRST_ID + end) for end in (source, target))
        seen = Rotation.from_rotvec([0.0, 0.0, angle + 0.003 * rng.normal()]).as_quat()
        estimator.add_edge(replace(EdgeMeasurement.from_ros(0, *ends, seen.tolist()), kind=kind))

    for robot, slip in (("a", 0.0), ("b", 1.0)):
        for i in range(STEPS):
            add(robot, i, i + 1, turn + slip * (i == SLIP), EdgeKind.ODOMETRY)
        for laps in (1, 2, 3):
            for i in range(0, STEPS - laps * LAP, 2):
                add(robot, i, i + laps * LAP, 0.0, EdgeKind.LOOP_CLOSURE)
    answer = estimator.tick(force_cold=True)
    assert answer is not None
    (warning,) = (text for text in answer.warnings if "slipped" in text)
    near = range(FIRST_ID + SLIP - 2, FIRST_ID + SLIP + 4)
    assert any(f"between nodes b {first} and b {last})" in warning for first in near for last in near), warning
