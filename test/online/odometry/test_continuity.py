"""Stamps far ahead, jumps, and odometry that begins anew: what is refused, what begins a new chain, what goes on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.online.odometry.continuity import ContinuityLimits
from rotavg_ros.online.odometry.samples import OdometryBounds
from rotavg_ros.online.odometry.track import OdometryTrack

SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND
YEAR = 365 * 86_400 * SECOND
BOUNDS = OdometryBounds(tolerance_ns=SECOND // 20, max_gap_ns=5 * SECOND, max_samples=1000)
LIMITS = ContinuityLimits(turn_rate=math.radians(360), speed=50.0, lead_ns=60 * SECOND)
HALF_TURN = 180.0


class Robot:
    """Odometry at 10 Hz on a straight line at 2 m/s; tells what became of every message."""

    def __init__(self) -> None:
        self.track = OdometryTrack(BOUNDS, LIMITS)
        self.stamp = START

    def say(self, heading_deg: float, metres: float | None, after_s: float = 0.1, stamp: int | None = None) -> str:
        self.stamp += round(after_s * SECOND)
        rotation = Rotation.from_euler("z", heading_deg, degrees=True).as_quat().tolist()
        position = None if metres is None else (metres, 0.0, 0.0)
        try:
            self.track.add(self.stamp if stamp is None else stamp, rotation, position)
        except RejectedInputError as rejection:
            return rejection.reason.value
        return f"chain {self.track.chain}"


def driven(seconds: float = 5.0, heading_deg: float = HALF_TURN, positions: bool = True) -> Robot:
    robot = Robot()
    for index in range(round(10 * seconds)):
        assert robot.say(heading_deg, 10 + 0.2 * index if positions else None) == "chain 0"
    return robot


@pytest.mark.parametrize("ahead", [61 * SECOND, YEAR, 40 * YEAR])
def test_a_stamp_far_ahead_stops_nothing(ahead):
    robot = driven()
    for _ in range(3):
        assert robot.say(180, 20, stamp=robot.stamp + ahead) == "future_stamp"
        assert robot.say(180, 20) == "chain 0"


def test_a_source_that_paused_loses_one_message():
    robot = driven()
    assert robot.say(180, 20, after_s=30) == "chain 0"
    assert robot.say(180, 20, after_s=3600) == "future_stamp"
    assert [robot.say(180, 20) for _ in range(3)] == ["chain 0"] * 3


def test_a_wild_pose_is_one_refusal():
    robot = driven()
    assert robot.say(0, 20) == "odometry_jump"
    assert robot.say(180, 20) == "chain 0"
    assert robot.say(180, 2000) == "odometry_jump"
    assert robot.say(180, 20) == "chain 0"


@pytest.mark.parametrize(
    ("heading", "positions"), [(180, True), (90, True), (25, True), (0, True), (180, False), (80, False)]
)
@pytest.mark.parametrize("silence", [0.1, 1.0, 30.0, 600.0])
def test_odometry_that_begins_anew_begins_a_chain(heading, positions, silence):
    robot = driven(heading_deg=heading, positions=positions)
    refused = "future_stamp" if silence > 60 else "odometry_jump"
    assert robot.say(0, 0.02 if positions else None, after_s=silence) == refused
    for index in range(1, 5):
        assert robot.say(3 * index, 0.2 * index if positions else None) == "chain 1"


def test_a_robot_that_comes_home_goes_on():
    """It passes the very place and heading where its odometry began, at full speed, turning on the spot as well."""
    robot = Robot()
    for index in range(100):
        assert robot.say(0, -10 + 0.2 * index) == "chain 0"
    robot = Robot()
    for index in range(100):
        assert robot.say(-60 + 30 * index, 0) == "chain 0", index


@pytest.mark.parametrize("jitter", [0.0, 0.3, 1.5])
@pytest.mark.parametrize(
    "way_home", [[(0, -2.4), (0, -1.2)], [(0, -6), (0, -1.5)], [(-50, 0), (-25, 0)], [(-67, 0), (-22, 0)]]
)
def test_a_robot_that_parks_where_its_odometry_began_goes_on(way_home, jitter):
    """However fast it came, braking or not, within or at the edge of what counts as zero; and it may drive off."""
    robot, random = Robot(), np.random.default_rng(0)
    for heading, metres in way_home:
        assert robot.say(heading, metres, after_s=1.0) == "chain 0"
    for heading, metres in jitter * random.uniform(-1, 1, size=(60, 2)) * [1.0, 0.1]:
        assert robot.say(heading, metres, after_s=1.0) == "chain 0"
    for index in range(1, 5):
        assert robot.say(0, 0.3 * index, after_s=1.0) == "chain 0"


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=30)
def test_motion_within_the_limits_is_one_chain(seed):
    random = np.random.default_rng(seed)
    track, rotation, position, stamp = OdometryTrack(BOUNDS, LIMITS), Rotation.random(random_state=seed), 5.0, START
    for _ in range(50):
        seconds = random.choice([0.005, 0.02, 0.1, 1.0, 20.0])
        stamp += round(seconds * SECOND)
        axis = random.normal(size=3)
        turn = min(random.uniform(0, math.radians(359)) * seconds, math.radians(60))
        rotation = rotation * Rotation.from_rotvec(turn * axis / np.linalg.norm(axis))
        position += random.uniform(0, 49) * seconds
        track.add(stamp, rotation.as_quat().tolist(), (position, 0.0, 0.0))
    assert track.chain == 0


def test_nothing_is_interpolated_between_chains():
    robot = driven()
    last = robot.stamp
    robot.say(0, 0, after_s=1.0)
    robot.say(0, 0.1)
    track = robot.track
    np.testing.assert_allclose(track.samples.world_from_body_at(last + SECOND // 25), [0, 0, 1, 0], atol=1e-12)
    assert track.samples.position_at(last + SECOND // 25)[0] == pytest.approx(19.8)
    with pytest.raises(RejectedInputError, match="odometry_gap"):
        track.samples.world_from_body_at(robot.stamp - SECOND // 25)
    np.testing.assert_allclose(track.samples.world_from_body_at(robot.stamp), [0, 0, 0, 1], atol=1e-12)
    assert (track.samples.chain_at(last), track.samples.chain_at(robot.stamp)) == (0, 1)
    restored = OdometryTrack.from_arrays(BOUNDS, track.arrays(), LIMITS)
    assert restored.chain == 1 and restored.last_keyframe is None


def test_restarts_at_any_moment_of_a_real_drive(shared_data):
    """Visual odometry of a car in a town; every message of it is believed, every restart of it is noticed."""
    poses = np.loadtxt(shared_data / "slam" / "kitti_mono_vo" / "05_pred.txt")[:, -12:].reshape(-1, 3, 4)
    rotation, position = Rotation.from_matrix(poses[:, :, :3]), poses[:, :, 3]
    stamps = START + np.arange(len(poses)) * SECOND // 10

    def chains(restart: int, start: int, stop: int) -> tuple[int, int]:
        """Chains that were begun and messages that were refused."""
        track, refused = OdometryTrack(BOUNDS, LIMITS), 0
        for index in range(start, stop):
            turned, moved = rotation[index], position[index]
            if index >= restart:
                turned = rotation[restart].inv() * turned
                moved = rotation[restart].inv().apply(moved - position[restart])
            try:
                track.add(int(stamps[index]), turned.as_quat().tolist(), moved.tolist())
            except RejectedInputError:
                refused += 1
        return track.chain, refused

    assert chains(len(poses), 0, len(poses)) == (0, 0)
    for restart in np.random.default_rng(0).integers(30, len(poses) - 10, 40).tolist():
        assert chains(restart, restart - 5, restart + 10) == (1, 1), restart
