"""Time that goes back: one stray message is not believed, a run of them is."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EstimatorOptions, OnlineEstimator, RejectReason

SECOND = 1_000_000_000
LENGTH = 60


def rotation(index: int) -> np.ndarray:
    return Rotation.from_rotvec([0.02 * index, 0, 0.1 * index]).as_quat()


def estimator(policy: str = "reset") -> OnlineEstimator:
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, on_time_jump=policy)
    return OnlineEstimator(options, lambda *_, **__: None)


def feed(online: OnlineEstimator, indices: range, offset_ns: int = 0) -> list[RejectReason | None]:
    return [online.add_odometry("r", offset_ns + index * SECOND // 10, rotation(index)) for index in indices]


def graph(online: OnlineEstimator) -> tuple[list[int], list[list[float]]]:
    snapshot = online.snapshot()
    return snapshot.stamp_ns.tolist(), snapshot.graph.target_from_source.tolist()


def test_a_bag_that_begins_again_leaves_the_graph_of_one_playing() -> None:
    once, twice = estimator(), estimator()
    feed(once, range(LENGTH))
    feed(twice, range(LENGTH))
    feed(twice, range(LENGTH))
    assert graph(twice) == graph(once), "the messages that proved the jump are not lost"
    assert twice.time_jumps == 1 and twice.counts().rejected == {}


@given(late=st.lists(st.tuples(st.integers(0, LENGTH - 1), st.integers(0, 10_000)), max_size=40))
def test_stray_old_messages_among_good_ones_change_nothing(late: list[tuple[int, int]]) -> None:
    """Up to four in a row whatever their stamps; a good message in between starts the count anew."""
    clean, mixed = estimator(), estimator()
    feed(clean, range(LENGTH), 1000 * SECOND)
    by_index: dict[int, list[int]] = {}
    for index, milliseconds in late:
        by_index.setdefault(index, []).append(milliseconds * SECOND // 1000)
    for index in range(LENGTH):
        feed(mixed, range(index, index + 1), 1000 * SECOND)
        for stamp_ns in by_index.get(index, [])[:4]:
            assert mixed.add_odometry("r", stamp_ns, rotation(0)) is RejectReason.OUT_OF_ORDER_ODOMETRY
    assert graph(mixed) == graph(clean) and mixed.time_jumps == 0


@pytest.mark.parametrize("policy", ["ignore", "error"])
def test_without_reset_the_graph_is_kept_until_time_is_ahead_again(policy: str) -> None:
    online = estimator(policy)
    feed(online, range(LENGTH))
    before = graph(online)
    assert set(feed(online, range(LENGTH - 1))) == {RejectReason.OUT_OF_ORDER_ODOMETRY}
    assert graph(online) == before and online.time_jumps == 1
    assert online.counts().time_is_back == (policy == "error")
    assert feed(online, range(LENGTH, LENGTH + 3)) == [None] * 3
    assert not online.counts().time_is_back


def test_a_small_step_back_is_only_out_of_order() -> None:
    online = estimator()
    feed(online, range(LENGTH))
    assert set(feed(online, range(LENGTH - 9, LENGTH - 1))) == {RejectReason.OUT_OF_ORDER_ODOMETRY}
    assert online.time_jumps == 0


def test_the_clock_tells_it_at_once_but_only_what_odometry_has_not() -> None:
    online = estimator()
    feed(online, range(LENGTH))
    online.clock_went_back(5 * SECOND + SECOND // 2)  # odometry is at 5.9 s
    assert online.counts().keyframes == LENGTH
    online.clock_went_back(0)
    assert online.counts().keyframes == 0 and online.time_jumps == 1
    feed(online, range(3))
    online.clock_went_back(0)
    assert online.counts().keyframes == 3 and online.time_jumps == 1
