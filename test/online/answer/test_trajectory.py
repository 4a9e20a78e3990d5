from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator
from rotavg_ros.online.answer.trajectory import dead_reckoning
from rotavg_ros.view_graph import EdgeKind

from ..drives import final


def test_a_square_that_odometry_bends_is_square_again():
    true_heading = np.radians([0, 90, 180, 270, 0])
    steps = np.stack((np.cos(true_heading), np.sin(true_heading), 0 * true_heading), axis=1)[:-1]
    truth = np.vstack((np.zeros(3), np.cumsum(steps, axis=0)))
    bent_heading = true_heading + np.radians([0, 5, 10, 15, 20])
    bent_steps = np.stack((np.cos(bent_heading), np.sin(bent_heading), 0 * bent_heading), axis=1)[:-1]
    bent = np.vstack((np.zeros(3), np.cumsum(bent_steps, axis=0)))
    corrected = dead_reckoning(
        Rotation.from_euler("z", true_heading[:, None]).as_quat(),
        Rotation.from_euler("z", bent_heading[:, None]).as_quat(),
        bent,
    )
    np.testing.assert_allclose(corrected, truth, atol=1e-12)


def test_positions_that_are_not_known_stay_unknown():
    orientation = np.tile([0, 0, 0, 1.0], (3, 1))
    assert np.isnan(dead_reckoning(orientation, orientation, np.full((3, 3), np.nan))).all()
    assert len(dead_reckoning(orientation[:1], orientation[:1], np.zeros((1, 3)))) == 1


def test_positions_go_on_after_some_that_are_not_known() -> None:
    """All that followed had been unknown."""
    orientation = np.tile([0, 0, 0, 1.0], (5, 1))
    turned = Rotation.from_euler("z", 90, degrees=True).as_quat()
    odometry = np.array([[2, 0, 0], [3, 0, 0], [np.nan] * 3, [7, 0, 0], [8, 0, 0]], dtype=float)
    expected = np.array([[2, 0, 0], [2, 1, 0], [np.nan] * 3, [2, 5, 0], [2, 6, 0]])
    np.testing.assert_allclose(dead_reckoning(np.tile(turned, (5, 1)), orientation, odometry), expected, atol=1e-12)
    unknown = np.where(np.isnan(odometry).any(axis=1)[:, None], np.nan, orientation)
    np.testing.assert_allclose(dead_reckoning(np.tile(turned, (5, 1)), unknown, odometry), expected, atol=1e-12)
    chain = np.array([0, 0, 0, 1, 1])
    expected[3:, 1] -= 4
    np.testing.assert_allclose(
        dead_reckoning(np.tile(turned, (5, 1)), orientation, odometry, chain), expected, atol=1e-12
    )


def test_a_tracker_that_finds_its_position_again_goes_on_there(solver) -> None:
    """Its keyframes from then on had begun at the origin, 32 m away."""
    online = OnlineEstimator(EstimatorOptions(keyframe_distance=0.5), solver)
    for message in range(300):
        second, place = 0.1 * message, (10 + 0.1 * message, 0.0, 0.0)
        turn = (0.0, 0.0, math.sin(0.02 * second), math.cos(0.02 * second))
        online.add_odometry("r", 100_000_000 * message, turn, (math.nan,) * 3 if 10 < second < 20 else place)
    poses = online.trajectories(final(online))["r"]
    known = np.isfinite(poses.odometry_position).all(axis=1)
    assert (poses.stamp_ns[known] > 20_000_000_000).sum() > 10
    for positions in (poses.position, poses.position_dead_reckoned):
        np.testing.assert_allclose(positions[known], poses.odometry_position[known], atol=1e-9)


def test_keyframes_between_two_messages_are_placed_between_them(solver) -> None:
    """The next message's pose had been taken: 14°, and half a metre, off; where odometry had ended, it stood still."""
    online = OnlineEstimator(EstimatorOptions(keyframe_source="edges"), solver)

    def circle(second: np.ndarray) -> tuple[Rotation, np.ndarray]:
        heading = 0.5 * second
        place = np.stack((np.sin(heading), 1 - np.cos(heading), 0 * heading), axis=-1) / 0.5
        return Rotation.from_euler("z", heading[..., None]), place

    messages, keyframes = np.arange(0, 20, 0.5), np.arange(0.1, 40, 0.7)
    for second, turn, place in zip(messages, *circle(messages), strict=True):
        online.add_odometry("r", round(1e9 * second), turn.as_quat(), place)
    turn = circle(keyframes)[0]
    steps = turn[1:].inv() * turn[:-1]
    ends = [KeyframeReference("r", number, round(1e9 * second)) for number, second in enumerate(keyframes.tolist())]
    for number, step in enumerate(steps.as_quat()):
        edge = EdgeMeasurement(number, ends[number], ends[number + 1], step, EdgeKind.ODOMETRY)
        assert online.add_edge(edge) is None
    poses = online.trajectories(final(online))["r"]
    is_reached = keyframes < messages[-1] + online.options.stamp_tolerance_s
    off = poses.odometry_position - circle(keyframes)[1]
    assert np.linalg.norm(off[is_reached], axis=1).max() < 0.02
    assert np.isnan(off[~is_reached]).all() and np.isnan(poses.position[~is_reached]).all()
    assert np.linalg.norm(np.diff(poses.position[is_reached], axis=0), axis=1) == pytest.approx(0.7, abs=0.02)
    turned = Rotation.from_quat(poses.odometry_world_from_body[is_reached]).inv() * turn[is_reached]
    assert turned.magnitude().max() < 1e-6
    np.testing.assert_array_equal(poses.on_path, np.flatnonzero(np.isfinite(poses.position[:, 0])))
