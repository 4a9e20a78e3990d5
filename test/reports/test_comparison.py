"""Errors against a reference: evo's own and SciPy's are the same."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from evo.core.metrics import APE, PoseRelation
from evo.core.trajectory import PosePath3D
from scipy.spatial.transform import Rotation

from rotavg_ros.replay.record import Reference
from rotavg_ros.reports.comparison import (
    Truth,
    compare,
    errors_of_orientations,
    fit_onto,
    truth_at_keyframes,
)

from .records import record_of, simulated_run


@pytest.mark.parametrize("dimensions", [2, 3])
def test_position_errors_are_evos(dimensions: int) -> None:
    (robot,) = record_of(simulated_run(300, dimensions=dimensions)).robots
    comparison = compare(robot, np.zeros(300, dtype=np.int64))
    assert comparison is not None
    assert robot.reference is not None
    for position, ours in (
        (robot.odometry_position, comparison.odometry_distance),
        (robot.position, comparison.corrected_distance),
    ):
        estimate = PosePath3D(position, np.tile([1.0, 0.0, 0.0, 0.0], (300, 1)))
        reference = PosePath3D(robot.reference.position, np.tile([1.0, 0.0, 0.0, 0.0], (300, 1)))
        estimate.align(reference)
        metric = APE(PoseRelation.translation_part)
        metric.process_data((reference, estimate))
        np.testing.assert_allclose(ours, metric.error, atol=1e-9)


def test_orientation_and_heading_errors() -> None:
    rng = np.random.default_rng(0)
    true = Rotation.random(200, rng=rng)
    # Off by a known heading, in a world that is turned against the reference's; most are exact and so fix the gauge.
    heading = np.where(np.arange(200) % 4 == 0, rng.uniform(-1, 1, 200), 0.0)
    estimate = Rotation.from_rotvec([0.3, 0.2, -1.0]) * Rotation.from_euler("z", heading[:, None]) * true
    errors = errors_of_orientations(estimate.as_quat(), Truth(true.as_quat(), None))
    np.testing.assert_allclose(errors.heading, heading, atol=1e-4)
    np.testing.assert_allclose(errors.angle, np.abs(heading), atol=1e-4)


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
    (robot,) = record_of(simulated_run(50)).robots
    assert robot.reference is not None
    nothing = replace(
        robot.reference, stamp_ns=np.empty(0, dtype=np.int64), world_from_body=np.empty((0, 4)), position=None
    )
    component = np.zeros(50, dtype=np.int64)
    assert compare(replace(robot, reference=None), component) is None
    assert compare(replace(robot, reference=nothing), component) is None
    assert fit_onto(np.zeros((1, 3)), np.zeros((1, 3))) is None
