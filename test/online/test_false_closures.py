"""The estimator against false closures that come at a bad moment, with the real solver."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.view_graph import EdgeKind

NUM_KEYFRAMES, FALSE_ID = 400, 10_000
STEP_DEG, CLOSURE_DEG = 0.2, 1.0


def edge(edge_id: int, source: int, target: int, turn_deg: float, kind: EdgeKind) -> EdgeMeasurement:
    """Between keyframes of a robot that truly never turns."""
    rotation = Rotation.from_euler("z", turn_deg, degrees=True).as_quat()
    return EdgeMeasurement(edge_id, KeyframeReference("r", source), KeyframeReference("r", target), rotation, kind)


def error_deg(answer: Answer) -> float:
    """Mean angle from the truth, which is the identity, as is the first keyframe."""
    return float(np.degrees(Rotation.from_quat(answer.world_from_body).magnitude().mean()))


def is_flagged(answer: Answer, edge_id: int) -> bool:
    return bool(answer.outlier[answer.edge_id == edge_id].item())


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("false_deg", [20.0, 90.0])
def test_a_false_closure_that_comes_first_gives_way_to_evidence(seed: int, false_deg: float) -> None:
    """A lone closure may be believed as long as nothing contradicts it; warm ticks let go of it once something does."""
    rng = np.random.default_rng(seed)
    drift = STEP_DEG * rng.standard_normal(NUM_KEYFRAMES)
    estimator = OnlineEstimator(EstimatorOptions(keyframe_source="edges", gauge="identity"))
    answer = None
    for keyframe in range(1, NUM_KEYFRAMES):
        estimator.add_edge(edge(keyframe, keyframe - 1, keyframe, drift[keyframe], EdgeKind.ODOMETRY))
        if keyframe == 300:
            estimator.add_edge(edge(FALSE_ID, 100, keyframe, false_deg, EdgeKind.LOOP_CLOSURE))
        if keyframe > 300 and keyframe % 10 == 0:
            turn = CLOSURE_DEG * rng.standard_normal()
            estimator.add_edge(edge(FALSE_ID + keyframe, keyframe - 250, keyframe, turn, EdgeKind.LOOP_CLOSURE))
        if keyframe % 30 == 9 and keyframe > 300:
            answer = estimator.tick()
    assert answer is not None and not answer.was_cold
    assert is_flagged(answer, FALSE_ID)
    assert answer.outlier.sum() <= 2
    odometry_error = float(np.abs(np.cumsum(drift)).mean())
    assert error_deg(answer) < max(1.5 * odometry_error, 1.0)
