"""Translations that come with edges: from the moments that were measured to the keyframes that carry them."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator

LENGTH = 40
KEYFRAME_EVERY = 4
STAMPS = 1_000_000_000 + 100_000_000 * np.arange(LENGTH)


@pytest.fixture(scope="module")
def drive() -> tuple[Rotation, np.ndarray]:
    """Orientation and position of a body that tumbles through space, without error."""
    rng = np.random.default_rng(3)
    steps = Rotation.from_rotvec(rng.normal(scale=0.3, size=(LENGTH, 3)))
    orientation = [steps[0]]
    for step in steps[1:]:
        orientation.append(orientation[-1] * step)
    return Rotation.concatenate(orientation), np.cumsum(rng.normal(size=(LENGTH, 3)), axis=0)


def estimator_after(drive: tuple[Rotation, np.ndarray], *, with_positions: bool = True) -> OnlineEstimator:
    every = EstimatorOptions(keyframe_angle=0.0, keyframe_distance=0.0, keyframe_interval_s=0.1 * KEYFRAME_EVERY)
    estimator = OnlineEstimator(every, lambda *_, **__: None)
    for stamp, rotation, position in zip(STAMPS.tolist(), drive[0].as_quat(), drive[1], strict=True):
        estimator.add_odometry("r", stamp, rotation.tolist(), position.tolist() if with_positions else None)
    return estimator


def measured(drive: tuple[Rotation, np.ndarray], source: int, target: int) -> EdgeMeasurement:
    orientation, position = drive
    ends = (KeyframeReference("r", stamp_ns=int(STAMPS[moment])) for moment in (source, target))
    return EdgeMeasurement(
        1,
        *ends,
        (orientation[target].inv() * orientation[source]).as_quat().tolist(),
        translation=orientation[source].inv().apply(position[target] - position[source]).tolist(),
    )


@given(data=st.data())
@settings(max_examples=40)
def test_a_closure_between_any_two_moments_is_tied_to_their_keyframes(drive, data) -> None:
    pair = st.lists(st.integers(0, LENGTH - 1), min_size=2, max_size=2, unique_by=lambda i: i // KEYFRAME_EVERY)
    source, target = data.draw(pair)
    estimator = estimator_after(drive)
    assert estimator.add_edge(measured(drive, source, target)) is None
    orientation, position = drive
    source, target = (KEYFRAME_EVERY * (moment // KEYFRAME_EVERY) for moment in (source, target))
    expected = orientation[source].inv().apply(position[target] - position[source])
    np.testing.assert_allclose(estimator.snapshot().translation[-1], expected, atol=1e-9)


def test_odometry_edges_carry_its_steps(drive) -> None:
    keyframes = slice(None, None, KEYFRAME_EVERY)
    orientation, position = drive[0][keyframes], drive[1][keyframes]
    expected = orientation[:-1].inv().apply(np.diff(position, axis=0))
    np.testing.assert_allclose(estimator_after(drive).snapshot().translation, expected, atol=1e-12)
    assert np.isnan(estimator_after(drive, with_positions=False).snapshot().translation).all()


@pytest.mark.parametrize("translation", [None, (math.nan, 0.0, 0.0), (0.0, math.inf, 0.0), (0.0, 0.0, -1e300)])
def test_a_closure_without_a_usable_translation_still_counts(drive, translation) -> None:
    estimator = estimator_after(drive)
    edge = measured(drive, 30, 2)
    unplaced = EdgeMeasurement(1, edge.source, edge.target, edge.target_from_source, translation=translation)
    assert estimator.add_edge(unplaced) is None
    assert np.isnan(estimator.snapshot().translation[-1]).all()


def test_a_saved_state_keeps_them(drive, tmp_path: Path) -> None:
    estimator = estimator_after(drive)
    estimator.add_edge(measured(drive, 30, 2))
    late = KeyframeReference("r", stamp_ns=int(STAMPS[-1]) + 10**9)
    waiting = EdgeMeasurement(2, measured(drive, 5, 1).source, late, (0.0, 0.0, 0.0, 1.0), translation=(1.0, 2.0, 3.0))
    estimator.add_edge(waiting)
    estimator.save(tmp_path / "state.npz")
    restored = OnlineEstimator(estimator.options, lambda *_, **__: None)
    restored.load(tmp_path / "state.npz")
    np.testing.assert_array_equal(restored.snapshot().translation, estimator.snapshot().translation)
    # What waits is placed once odometry has come to its moment; the robot stands still until then.
    for stamp in range(int(STAMPS[-1]) + 10**8, late.stamp_ns + 2 * 10**8, 10**8):
        restored.add_odometry("r", stamp, drive[0][-1].as_quat().tolist(), drive[1][-1].tolist())
    snapshot = restored.snapshot()
    orientation, position = drive
    way = orientation[4].inv().apply(position[5] - position[4] + orientation[5].apply([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(snapshot.translation[snapshot.edge_id == 2], [way], atol=1e-9)
