"""A robot's run against its reference."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from rotavg_ros.metrics import position_errors
from rotavg_ros.replay.comparison import Truth, compare, errors_of_orientations, truth_at_keyframes
from rotavg_ros.replay.record import Reference, RobotRecord

COUNT = 80


def robot(seed: int = 0) -> RobotRecord:
    """A robot of 80 keyframes whose odometry drifts, and a reference at the same stamps."""
    rng = np.random.default_rng(seed)
    stamps = 1_700_000_000_000_000_000 + 100_000_000 * np.arange(COUNT)
    position, orientation = np.cumsum(rng.normal(size=(COUNT, 3)), axis=0), Rotation.random(COUNT, rng=rng)
    drift = Rotation.from_rotvec(0.01 * rng.normal(size=(COUNT, 3)).cumsum(axis=0))
    return RobotRecord(
        robot="robot",
        nodes=np.arange(COUNT),
        stamp_ns=stamps,
        time_line=np.zeros(COUNT, dtype=np.int64),
        keyframe_id=np.arange(COUNT, dtype=np.uint64),
        odometry_world_from_body=(drift * orientation).as_quat(),
        odometry_position=drift.apply(position),
        world_from_body=orientation.as_quat(),
        position_dead_reckoned=None,
        position=position + rng.normal(scale=0.1, size=(COUNT, 3)),
        uncertainty=np.full(COUNT, 0.01),
        reference=Reference("truth", stamps, orientation.as_quat(), position),
    )


def test_every_trajectory_is_compared_by_itself() -> None:
    record = robot()
    comparison = compare(record, np.zeros(COUNT, dtype=np.int64))
    assert comparison is not None and record.reference is not None
    truth = record.reference.position
    assert truth is not None and record.odometry_position is not None and record.position is not None
    np.testing.assert_allclose(comparison.odometry_distance, position_errors(record.odometry_position, truth))
    np.testing.assert_allclose(comparison.corrected_distance, position_errors(record.position, truth))
    assert np.isnan(comparison.dead_reckoned_distance).all()
    assert comparison.corrected.angle.max() < 1e-6 < comparison.odometry.angle.mean()


def test_what_is_not_corrected_has_the_errors_of_odometry_whatever_its_parts_frames() -> None:
    record = robot()
    assert record.odometry_position is not None
    component = np.repeat([0, 1], COUNT // 2)
    begun_anew = Rotation.from_euler("z", 2.0 * component[:, None])
    orientation, position = Rotation.from_quat(record.odometry_world_from_body), record.odometry_position
    odometry = replace(
        record,
        odometry_world_from_body=(begun_anew * orientation).as_quat(),
        odometry_position=begun_anew.apply(position) + 30.0 * component[:, None],
        world_from_body=record.odometry_world_from_body,
        position=position,
    )
    comparison = compare(odometry, component)
    assert comparison is not None
    np.testing.assert_allclose(comparison.odometry.angle, comparison.corrected.angle, atol=1e-9)
    np.testing.assert_allclose(comparison.odometry_distance, comparison.corrected_distance, atol=1e-9)
    for part in (component == 0, component == 1):
        alone = compare(
            replace(
                odometry,
                stamp_ns=odometry.stamp_ns[part],
                time_line=odometry.time_line[part],
                odometry_world_from_body=odometry.odometry_world_from_body[part],
                odometry_position=position[part],
                world_from_body=odometry.world_from_body[part],
                position=position[part],
            ),
            component[part],
        )
        assert alone is not None
        np.testing.assert_allclose(comparison.corrected_distance[part], alone.corrected_distance, atol=1e-9)


def test_orientation_and_heading_errors() -> None:
    rng = np.random.default_rng(0)
    true = Rotation.random(200, rng=rng)
    # Off by a known heading, in a world that is turned against the reference's; most are exact and so fix the gauge.
    heading = np.where(np.arange(200) % 4 == 0, rng.uniform(-1, 1, 200), 0.0)
    estimate = Rotation.from_rotvec([0.3, 0.2, -1.0]) * Rotation.from_euler("z", heading[:, None]) * true
    errors = errors_of_orientations(estimate.as_quat(), Truth(true.as_quat(), None))
    np.testing.assert_allclose(errors.heading, heading, atol=1e-4)
    np.testing.assert_allclose(errors.angle, np.abs(heading), atol=1e-4)


def test_a_heading_that_is_off_by_half_a_turn(monkeypatch: pytest.MonkeyPatch) -> None:
    none, half = [0.0, 0.0, 0.0, 1.0], [0.0, 0.0, 1.0, 0.0]
    monkeypatch.setattr("rotavg_ros.replay.comparison.gauge_alignment", lambda *_: torch.tensor(none))
    errors = errors_of_orientations(np.array([none, half]), Truth(np.array([none, none]), None))
    np.testing.assert_array_equal(np.abs(errors.heading), [0, np.pi])


def test_components_are_turned_by_themselves_and_gaps_stay_unknown() -> None:
    rng = np.random.default_rng(1)
    true = Rotation.random(40, rng=rng)
    component = np.repeat([0, 1], 20)
    gauges = Rotation.random(2, rng=rng)
    estimate = (gauges[component] * true).as_quat()
    reference = true.as_quat()
    reference[7] = np.nan
    estimate[30] = np.nan
    errors = errors_of_orientations(estimate, Truth(reference, None), component)
    assert np.flatnonzero(np.isnan(errors.angle)).tolist() == [7, 30]
    np.testing.assert_allclose(errors.angle[~np.isnan(errors.angle)], 0, atol=1e-7)


def test_the_reference_is_interpolated_where_it_is_dense() -> None:
    stamps = np.array([0, 100, 200, 1000, 1100]) * 1_000_000 + 1_700_000_000_000_000_000
    turns = np.radians([0.0, 10.0, 20.0, 90.0, 100.0])
    reference = Reference(
        name="",
        stamp_ns=stamps[::-1],
        world_from_body=Rotation.from_euler("z", turns[::-1, None]).as_quat(),
        position=np.outer(turns[::-1], [1.0, 2.0, 3.0]),
    )
    asked = np.array([50, 100, 1075, 600, -100, 1300]) * 1_000_000 + 1_700_000_000_000_000_000
    truth = truth_at_keyframes(reference, asked)
    assert truth.position is not None
    known = np.isfinite(truth.world_from_body).all(axis=1)
    # In the gap and far behind the end nothing is known; just outside, the nearest sample counts.
    assert known.tolist() == [True, True, True, False, True, False]
    angle = Rotation.from_quat(truth.world_from_body[known]).as_euler("zyx")[:, 0]
    np.testing.assert_allclose(np.degrees(angle), [5.0, 10.0, 97.5, 0.0], atol=1e-6)
    np.testing.assert_allclose(truth.position[known, 2], 3 * np.radians([5.0, 10.0, 97.5, 0.0]), atol=1e-9)


def test_too_little_to_compare_with() -> None:
    record = robot()
    assert record.reference is not None
    nothing = replace(
        record.reference, stamp_ns=np.empty(0, dtype=np.int64), world_from_body=np.empty((0, 4)), position=None
    )
    component = np.zeros(COUNT, dtype=np.int64)
    assert compare(replace(record, reference=None), component) is None
    assert compare(replace(record, reference=nothing), component) is None
