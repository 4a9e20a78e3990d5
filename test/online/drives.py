"""Robots that turn at random, with noise-free closures, and the estimator that they feed."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.spatial.transform import Rotation

from rotavg_ros.online import Answer, EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator

SECOND = 1_000_000_000
# Keyframes every third message, so that most stamps lie between keyframes.
OPTIONS = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, keyframe_interval_s=0.3)


@dataclass(frozen=True)
class Drive:
    """A robot's true orientations at 10 Hz, and its odometry, which drifts: world_from_body, scipy."""

    stamps: np.ndarray
    truth: Rotation
    odometry: Rotation


def drive(length: int = 40, drift_deg: float = 0.0, seed: int = 0) -> Drive:
    random = np.random.default_rng(seed)
    truth, odometry = [Rotation.random(random_state=seed)], [Rotation.random(random_state=seed + 1)]
    for _ in range(length - 1):
        step = Rotation.from_rotvec(random.normal(0, 0.2, 3))
        truth.append(truth[-1] * step)
        odometry.append(odometry[-1] * step * Rotation.from_rotvec(np.radians([0, 0, drift_deg])))
    stamps = 1_700_000_000 * SECOND + np.arange(length) * SECOND // 10
    return Drive(stamps, Rotation.concatenate(truth), Rotation.concatenate(odometry))


def at(stamp: int, robot: str = "r") -> KeyframeReference:
    return KeyframeReference(robot, stamp_ns=int(stamp))


def closure(run: Drive, edge_id: int, source: int, target: int, robot: str = "r") -> EdgeMeasurement:
    """The true relative rotation of two moments, target_from_source = R_target R_source⁻¹ with R body_from_world."""
    rotation = run.truth[target].inv() * run.truth[source]
    return EdgeMeasurement(edge_id, at(run.stamps[source], robot), at(run.stamps[target], robot), rotation.as_quat())


def feed(estimator: OnlineEstimator, run: Drive, robot: str = "r", start: int = 0, stop: int | None = None) -> None:
    for stamp, rotation in list(zip(run.stamps.tolist(), run.odometry.as_quat().tolist(), strict=True))[start:stop]:
        assert estimator.add_odometry(robot, stamp, rotation) is None


def make(solver, options: EstimatorOptions = OPTIONS) -> OnlineEstimator:
    return OnlineEstimator(options, solver)


def final(estimator: OnlineEstimator) -> Answer:
    """The answer once the input is silent."""
    answer, worked = None, 1.0
    while (newer := estimator.tick()) is not None or worked:
        answer, worked = newer or answer, estimator.go_on()
    assert answer is not None and answer.was_cold
    return answer
