from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation, Slerp

from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.odometry.keyframe_choice import KeyframePolicy
from rotavg_ros.online.odometry.samples import OdometryBounds
from rotavg_ros.online.odometry.track import OdometryTrack

BOUNDS = OdometryBounds(tolerance_ns=5, max_gap_ns=100, max_samples=1000)


def yaw(degrees: float) -> list[float]:
    return Rotation.from_euler("z", degrees, degrees=True).as_quat().tolist()


@pytest.mark.parametrize(
    ("policy", "expected"),
    [
        (KeyframePolicy(math.radians(10), 0, 0), [0, 2, 4]),
        (KeyframePolicy(0, 1.5, 0), [0, 2, 4]),
        (KeyframePolicy(0, 0, 30), [0, 3]),
        (KeyframePolicy(math.radians(10), 0.9, 1000), [0, 1, 2, 3, 4]),
        (KeyframePolicy(0, 0, 0), [0, 1, 2, 3, 4]),
        (KeyframePolicy(-1, -1, -1), [0, 1, 2, 3, 4]),
        (KeyframePolicy(math.radians(90), 100, 1000), [0]),
    ],
)
def test_selection(policy, expected):
    track, chosen = OdometryTrack(BOUNDS), []
    for index in range(5):
        track.add(10 * index, yaw(6.0 * index), (1.0 * index, 0, 0))
        if track.reached(policy):
            track.mark_keyframe()
            chosen.append(index)
    assert chosen == expected


def test_distance_counts_only_with_positions():
    policy = KeyframePolicy(0, 1, 0)
    for position in (None, (math.nan, 0, 0), (math.inf, 0, 0)):
        track = OdometryTrack(BOUNDS)
        track.add(0, yaw(0), (0, 0, 0))
        track.mark_keyframe()
        track.add(1, yaw(0), position)
        assert not track.reached(policy)


def _keyframes(positions: list, restarts: bool = False) -> list[int]:
    """Stamps of those chosen of messages 10 ns apart that turn by 6° each; every 10° makes one."""
    track, chosen = OdometryTrack(BOUNDS), []
    for index, position in enumerate(positions):
        track.add(10 * index, yaw(6.0 * index), position)
        if track.reached(KeyframePolicy(math.radians(10), 0, 0)):
            track.mark_keyframe()
            chosen.append(10 * index)
        if restarts:
            track = OdometryTrack.from_arrays(BOUNDS, track.arrays())
    return chosen


HERE, LOST = (1.0, 2.0, 3.0), (math.nan, math.nan, math.nan)


@pytest.mark.parametrize(
    ("positions", "expected"),
    [
        ([HERE] * 8, [0, 20, 40, 60]),
        ([None] * 8, [0, 20, 40, 60]),  # odometry that has none
        ([LOST] * 3 + [HERE] * 5, [30, 50, 70]),
        ([HERE, HERE, LOST, HERE, LOST, LOST, HERE, HERE], [0, 30, 60]),
        ([LOST] * 16, [110, 130, 150]),  # no longer than odometry may pause
        ([HERE] + [LOST] * 14, [0, 120, 140]),
    ],
)
def test_a_message_whose_position_is_lost_waits_for_one_that_has_it(positions: list, expected: list[int]) -> None:
    assert _keyframes(positions) == expected
    assert _keyframes(positions, restarts=True) == expected  # it had waited anew after each


@pytest.mark.parametrize(
    ("stamp", "rotation", "reason"),
    [
        (9, [0, 0, 0, 1], "out_of_order_odometry"),
        (10, [0, 0, 0, 1], "repeated_stamp"),
        (-1, [0, 0, 0, 1], "bad_stamp"),
        (2**63, [0, 0, 0, 1], "bad_stamp"),
        (20, [0, 0, math.nan, 1], "nan_rotation"),
        (20, [0, 0, math.inf, 1], "nan_rotation"),
        (20, [0, 0, 1e200, 1], "nan_rotation"),
        (20, [0, 0, 0, 0], "zero_quaternion"),
        (20, [0, 0, 0, 1.1], "unnormalized_quaternion"),
        (20, [0, 0, 0, 0.5], "unnormalized_quaternion"),
    ],
)
def test_refusals_change_nothing(stamp, rotation, reason):
    track = OdometryTrack(BOUNDS)
    track.add(10, yaw(1), None)
    before = track.latest
    with pytest.raises(RejectedInputError, match=reason):
        track.add(stamp, rotation, None)
    assert track.latest == before
    assert len(track.arrays()["stamp_ns"]) == 1


def test_interpolation_against_scipy():
    rotations = Rotation.random(20, random_state=3)
    stamps = np.cumsum(np.random.default_rng(3).integers(1, 100, 20)) + 1_700_000_000_000_000_000
    track = OdometryTrack(BOUNDS)
    for stamp, rotation in zip(stamps.tolist(), rotations.as_quat().tolist(), strict=True):
        track.add(stamp, rotation, None)
    slerp = Slerp(stamps - stamps[0], rotations)
    for query in range(int(stamps[0]), int(stamps[-1]), 7):
        expected = slerp(query - stamps[0]).as_quat(canonical=True)
        np.testing.assert_allclose(track.samples.world_from_body_at(query), expected, atol=1e-12)


def test_the_tolerance_and_gaps_bound_what_is_known():
    track = OdometryTrack(BOUNDS)
    track.add(1000, yaw(10), None)
    track.add(1200, yaw(30), None)
    for stamp, degrees in ((995, 10), (1005, 10), (1195, 30), (1205, 30)):
        np.testing.assert_allclose(track.samples.world_from_body_at(stamp), yaw(degrees), atol=1e-15)
    for stamp, reason in ((994, "stamp_out_of_range"), (1206, "stamp_out_of_range"), (1100, "odometry_gap")):
        with pytest.raises(RejectedInputError, match=reason):
            track.samples.world_from_body_at(stamp)
    assert track.reaches(1200) and not track.reaches(1201)
    assert track.within_tolerance(1205) and not track.within_tolerance(1206)


def test_old_messages_are_thinned_out_but_keyframes_stay():
    track = OdometryTrack(OdometryBounds(5, 10**9, max_samples=100))
    policy = KeyframePolicy(0, 0, 50)
    keyframes = []
    for index in range(2000):
        track.add(10 * index, yaw(0.1 * index), None)
        if track.reached(policy):
            track.mark_keyframe()
            keyframes.append(10 * index)
    stamps = track.arrays()["stamp_ns"]
    assert len(stamps) < 3 * len(keyframes)
    assert set(keyframes) <= set(stamps.tolist())
    for stamp in (0, 333, 5005, 19_985):
        np.testing.assert_allclose(
            Rotation.from_quat(track.samples.world_from_body_at(stamp)).as_euler("xyz", degrees=True)[2] % 360,
            0.01 * stamp % 360,
            atol=1e-9,
        )
