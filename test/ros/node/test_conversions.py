"""The border: directions against gtsam, fields, counting."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

pytest.importorskip("rclpy", reason="ROS 2 is not installed; `make setup` installs it")
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Quaternion
from nav_msgs.msg import Odometry
from rotavg_msgs.msg import KeyframeReference, RelativeRotation, RelativeRotationArray
from sensor_msgs.msg import Imu

from rotavg_ros.errors import UserError
from rotavg_ros.inputs import Source
from rotavg_ros.inputs.fields import to_nanoseconds
from rotavg_ros.inputs.rotavg import edge_from_message
from rotavg_ros.online.measurements import RejectedInputError
from rotavg_ros.ros.node.intake import adapters
from rotavg_ros.ros.node.message_counting import Durations, SequenceGaps, TopicCounter
from rotavg_ros.ros.node.output.conversions import to_time

DEFAULT = adapters.DEFAULT_EDGE_TYPE


def message(source_from_target: Rotation) -> RelativeRotation:
    x, y, z, w = source_from_target.as_quat().tolist()
    return RelativeRotation(
        id=2**64 - 1,
        sequence=7,
        source=KeyframeReference(robot="a", id=3, stamp=Time(sec=5)),
        target=KeyframeReference(by=KeyframeReference.BY_STAMP, stamp=Time(sec=9, nanosec=1)),
        rotation=Quaternion(x=x, y=y, z=z, w=w),
        precision=4.0,
        kind=RelativeRotation.LOOP_CLOSURE,
    )


def test_direction_agrees_with_gtsam() -> None:
    """What gtsam measures between two poses is what a message carries, and inside it is R_target R_source⁻¹."""
    gtsam = pytest.importorskip("gtsam")
    world_from_source, world_from_target = Rotation.random(2, random_state=0)
    poses = [gtsam.Rot3(rotation.as_matrix()) for rotation in (world_from_source, world_from_target)]
    carried = Rotation.from_matrix(poses[0].between(poses[1]).matrix())
    edge = edge_from_message(message(carried), Source("r"))
    expected = world_from_target.inv() * world_from_source
    np.testing.assert_allclose(edge.target_from_source, expected.as_quat(canonical=True), atol=1e-12)


def test_a_sensor_that_is_turned_in_the_body() -> None:
    body_from_sensor, world_from_source, world_from_target = Rotation.random(3, random_state=1)
    sensor_source, sensor_target = world_from_source * body_from_sensor, world_from_target * body_from_sensor
    x, y, z, w = body_from_sensor.as_quat().tolist()
    edge = edge_from_message(message(sensor_source.inv() * sensor_target), Source("r", (), (x, y, z, w)))
    between = Rotation.from_quat(edge.target_from_source).inv() * (world_from_target.inv() * world_from_source)
    assert between.magnitude() < 1e-12


def test_fields() -> None:
    edge = edge_from_message(message(Rotation.identity()), Source("default"))
    assert (edge.edge_id, edge.kind, edge.precision) == (2**64 - 1, 1, 4.0)
    assert (edge.source.robot, edge.source.keyframe_id, edge.source.stamp_ns) == ("a", 3, 5 * 10**9)
    assert (edge.target.robot, edge.target.keyframe_id, edge.target.stamp_ns) == ("default", None, 9 * 10**9 + 1)


def test_a_translation_in_the_plane_is_refused_and_not_left_out() -> None:
    """It would silently count as unknown, and places would not be judged."""
    told = message(Rotation.identity())
    for translation, known in (([], None), ([1.0, 2.0, 3.0], (1.0, 2.0, 3.0))):
        told.translation = translation
        assert edge_from_message(told, Source("default")).translation == known
    for translation in ([1.0], [1.0, 2.0]):
        told.translation = translation
        with pytest.raises(RejectedInputError, match="wrong_length"):
            edge_from_message(told, Source("default"))


def test_stamps() -> None:
    assert to_nanoseconds(Time(sec=2, nanosec=3)) == 2_000_000_003
    assert to_time(2_000_000_003) == Time(sec=2, nanosec=3)
    assert to_time(-1) == Time() and to_time(2**62) == Time()
    for bad in (Time(sec=-1), Time(nanosec=10**9)):
        with pytest.raises(RejectedInputError, match="bad_stamp"):
            to_nanoseconds(bad)


def test_adapters() -> None:
    single = adapters.edge_topic("edges", Source("r"))
    assert single.topic == "edges" and single.message_type is RelativeRotation
    array = adapters.edge_topic("a/b:rotavg_msgs/msg/RelativeRotationArray", Source("r"))
    good, bad = message(Rotation.identity()), message(Rotation.identity())
    bad.source.by = 9
    records = list(array.convert(RelativeRotationArray(edges=[good, bad])))
    assert [record.sequence for record in records] == [7, 7]
    assert records[0].edge.edge_id == 2**64 - 1 and records[1].edge == "bad_reference"
    imu = adapters.odometry_topic("imu/data:sensor_msgs/msg/Imu")
    assert (imu.topic, imu.message_type) == ("imu/data", Imu)
    assert adapters.odometry_topic("odom").message_type is Odometry


@pytest.mark.parametrize("entry", ["x:unheard_msgs/msg/Of", "x:y", ":rotavg_msgs/msg/RelativeRotation", ""])
def test_entries_that_cannot_be(entry: str) -> None:
    for load in (adapters.odometry_topic, lambda entry: adapters.edge_topic(entry, Source("r"))):
        with pytest.raises(UserError, match=r"topic"):
            load(entry)


def test_a_package_that_is_missing_is_named(monkeypatch) -> None:
    monkeypatch.setitem(adapters.EDGE_CONVERTERS, "unheard_msgs/msg/Of", adapters.EDGE_CONVERTERS[DEFAULT])
    with pytest.raises(UserError, match="install the package unheard_msgs"):
        adapters.edge_topic("x:unheard_msgs/msg/Of", Source("r"))


@pytest.mark.parametrize(
    ("numbers", "lost", "before_first"),
    [
        ([1, 2, 3], 0, 0),
        ([1, 2, 5, 6, 9], 4, 0),
        ([4, 5], 0, 3),
        ([8, 9, 1, 2, 4], 1, 7),
        ([1, 2, 2, 2, 3], 0, 0),
        ([0, 0, 0], 0, 0),
        ([1, 2, 4_000_000_000, 4_000_000_001], 0, 0),
    ],
)
def test_sequence_gaps(numbers: list[int], lost: int, before_first: int) -> None:
    gaps = SequenceGaps()
    for number in numbers:
        gaps.observe("a", number)
    gaps.observe("b", 1)
    assert (gaps.lost, gaps.before_first) == (lost, before_first)


SENDERS = st.lists(st.tuples(st.sampled_from("ab"), st.integers(1, 40)), min_size=1, max_size=4)


@given(senders=SENDERS, turns=st.lists(st.integers(0, 3), max_size=60))
def test_senders_that_speak_of_the_same_robots_lose_nothing(senders: list[tuple[str, int]], turns: list[int]) -> None:
    """Each counts for itself, in any order; when all have gone on for a while nothing is taken for lost."""
    gaps, numbers = SequenceGaps(), [number for _, number in senders]
    for turn in [*turns, *5 * list(range(len(senders)))]:
        sender = turn % len(senders)
        gaps.observe(senders[sender][0], numbers[sender])
        numbers[sender] += 1
        assert gaps.lost >= 0
    assert gaps.lost == 0


@given(kept=st.sets(st.integers(3, 60)), about=st.lists(st.sampled_from("ab"), min_size=60, max_size=60))
def test_a_sender_that_speaks_of_several_robots(kept: set[int], about: list[str]) -> None:
    gaps, numbers = SequenceGaps(), [1, 2, *sorted(kept)]
    for robot, number in zip(["a", "b", *about], numbers, strict=False):
        gaps.observe(robot, number)
    assert gaps.lost == numbers[-1] - len(numbers)


def test_two_front_ends_of_which_both_lose_messages() -> None:
    gaps = SequenceGaps()
    for number in range(1, 100):
        for first, lost in ((0, {20, 30, 31}), (5000, {7})):
            if number not in lost:
                gaps.observe("a", first + number)
    assert gaps.lost == 4


def test_the_middlewares_numbers_count_only_for_a_single_publisher() -> None:
    counter = TopicCounter()
    for number, publishers in ((1, 1), (3, 1), (9, 2), (4, 1)):
        counter.observe({"publication_sequence_number": number}, publishers)
    counter.observe(None, 1)
    assert (counter.received, counter.by_middleware.lost, counter.lost) == (5, 1, 1)


def test_a_publisher_that_was_killed_and_starts_again_has_lost_nothing() -> None:
    """For twenty seconds DDS has two of them; when it has one again, that one's numbers have gone on."""
    counter = TopicCounter()
    for numbers, publishers in ((range(1, 101), 1), (range(1, 174), 2), (range(174, 200), 1)):
        for number in numbers:
            counter.observe({"publication_sequence_number": number}, publishers)
    assert (counter.received, counter.lost, counter.before_first) == (299, 0, 0)
    counter.observe({"publication_sequence_number": 203}, 1)
    assert counter.lost == 3


def test_durations() -> None:
    durations = Durations(length=3)
    assert math.isnan(durations.percentile_ms(50))
    for seconds in (9.0, 1.0, 2.0, 3.0):
        durations.add(seconds)
    assert durations.percentile_ms(50) == 2000 and durations.longest == 9.0 and durations.count == 4
