"""Odometry messages that are read while others come."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.odometry.continuity import OdometrySample
from rotavg_ros.online.odometry.samples import OdometryBounds, OdometrySamples

SECOND = 1_000_000_000


def test_what_is_frozen_stays_though_messages_come_and_old_ones_are_thinned_out() -> None:
    samples = OdometrySamples(OdometryBounds(tolerance_ns=5, max_gap_ns=100, max_samples=100))

    def add(first: int, last: int) -> None:
        for stamp in range(first, last):
            turn = (0.0, 0.0, float(np.sin(stamp)), float(np.cos(stamp)))
            samples.append(OdometrySample(stamp, turn, (float(stamp), 0.0, 0.0)), 0, 0)

    add(0, 100)
    frozen, stamps = samples.frozen(), np.arange(100)
    before = frozen.poses_at(stamps, np.zeros(100, dtype=np.int64))
    add(100, 1000)
    assert len(samples) < 1000 and len(frozen) == 100
    for was, now in zip(before, frozen.poses_at(stamps, np.zeros(100, dtype=np.int64)), strict=True):
        np.testing.assert_array_equal(was, now)
    np.testing.assert_array_equal(before[1][:, 0], stamps)


def heading_deg(second: float) -> float:
    """A robot that turns by 30° a second, apart from a rest of three minutes after the first 50 s."""
    return 30 * (second if second < 50 else max(50.0, second - 180))


def thinned_out(pauses: tuple[float, float] = (0.0, 0.0)) -> OdometrySamples:
    """Six minutes of the robot's odometry at 20 Hz, apart from a pause, of which a seventh is kept."""
    samples = OdometrySamples(OdometryBounds(tolerance_ns=0, max_gap_ns=2 * SECOND, max_samples=1000))
    for second in np.arange(0, 360, 0.05).tolist():
        if not pauses[0] < second < pauses[1]:
            half = math.radians(heading_deg(second)) / 2
            turn = (0.0, 0.0, math.sin(half), math.cos(half))
            samples.append(OdometrySample(round(second * SECOND), turn, (1.0, 2.0, 0.0)), 0, 0)
    return samples


def off_deg(samples: OdometrySamples, seconds: np.ndarray) -> np.ndarray:
    """How far the rotation at each moment is off, degrees; NaN where it is refused."""

    def off(second: float) -> float:
        try:
            _, _, z, w = samples.world_from_body_at(round(second * SECOND))
        except RejectedInputError:
            return math.nan
        return abs((math.degrees(2 * math.atan2(z, w)) - heading_deg(second) + 180) % 360 - 180)

    return np.array([off(second) for second in seconds.tolist()])


@pytest.mark.parametrize("restart", [False, True])
def test_moments_at_which_the_robot_stood_still_are_known_though_messages_were_thinned_out(restart: bool) -> None:
    """Odometry was there all the time: nothing but thinning makes gaps that are longer than the limit."""
    samples = thinned_out()
    if restart:
        samples = OdometrySamples.from_arrays(samples.bounds, samples.arrays())
    assert len(samples) <= 1250
    assert np.diff(samples.stamps_ns).max() > 20 * SECOND
    assert off_deg(samples, np.arange(52, 229, 0.37)).max() < 1.1
    assert np.nanmax(off_deg(samples, np.arange(0, 48, 0.37))) < 1e-6  # no rotation is made up while it turned


def test_a_pause_of_odometry_stays_a_gap_where_messages_are_thinned_out() -> None:
    off = off_deg(thinned_out(pauses=(100.0, 104.0)), np.array([80.0, 102.0, 200.0]))
    assert np.isnan(off).tolist() == [False, True, False]


@settings(max_examples=50, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_many_poses_are_those_of_each_moment(seed: int) -> None:
    random = np.random.default_rng(seed)
    samples = OdometrySamples(OdometryBounds(*(int(random.integers(*ends)) for ends in ((0, 8), (5, 40), (8, 60)))))
    chain = time_line = 0
    stamp, turn = int(random.integers(50)), Rotation.random(random_state=random)
    for _ in range(int(random.integers(1, 60))):
        place = None if random.random() < 0.1 else tuple(random.normal(0, 5, 3).tolist())
        x, y, z, w = turn.as_quat(canonical=True).tolist()
        samples.append(OdometrySample(stamp, (x, y, z, w), place), chain, time_line)
        begins, goes_back = random.random(2) < (0.1, 0.05)
        chain, time_line = chain + (begins or goes_back), time_line + goes_back
        stamp = int(random.integers(50)) if goes_back else stamp + int(random.integers(1, 30))
        turn *= Rotation.from_rotvec(random.normal(0, 0.6, 3) * (random.random() < 0.7))
    stamps = np.append(random.choice(samples.stamps_ns, 10), random.integers(-20, samples.stamps_ns.max() + 50, 50))
    lines = random.integers(0, samples.last_time_line + 1, 60)
    for at, line, *found in zip(stamps.tolist(), lines.tolist(), *samples.poses_at(stamps, lines), strict=True):
        try:
            expected = samples.world_from_body_at(at, line), samples.position_at(at, line), samples.chain_at(at, line)
        except RejectedInputError:
            expected = (math.nan,) * 4, (math.nan,) * 3, -1
        for one, other in zip(found, expected, strict=True):
            np.testing.assert_allclose(one, other, rtol=0, atol=1e-9)
