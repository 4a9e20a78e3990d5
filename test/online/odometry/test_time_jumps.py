"""Time that goes back: one stray message is not believed, a run of them is, and nothing is forgotten unasked."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from rotavg_ros.online import EdgeMeasurement, EstimatorOptions, KeyframeReference, OnlineEstimator, RejectReason
from rotavg_ros.online.graph import room
from rotavg_ros.view_graph import EdgeKind

SECOND = 1_000_000_000
LENGTH = 60


def rotation(index: int) -> np.ndarray:
    return Rotation.from_rotvec([0.02 * index, 0, 0.1 * index]).as_quat()


def estimator(policy: str) -> OnlineEstimator:
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, on_time_jump=policy)
    return OnlineEstimator(options, lambda *_, **__: None)


def feed(online: OnlineEstimator, indices: range, offset_ns: int = 0) -> list[RejectReason | None]:
    return [online.add_odometry("r", offset_ns + index * SECOND // 10, rotation(index)) for index in indices]


def graph(online: OnlineEstimator) -> tuple[list[int], list[list[float]]]:
    snapshot = online.snapshot()
    return snapshot.stamp_ns.tolist(), snapshot.graph.target_from_source.tolist()


def test_with_reset_a_bag_that_begins_again_leaves_the_graph_of_one_playing() -> None:
    once, twice = estimator("reset"), estimator("reset")
    feed(once, range(LENGTH))
    feed(twice, range(LENGTH))
    feed(twice, range(LENGTH))
    assert graph(twice) == graph(once), "the messages that proved the jump are not lost"
    assert twice.time_jumps == 1 and twice.counts().rejected == {}


@pytest.mark.parametrize("max_gap_s", [0.0, 5.0])
@pytest.mark.parametrize(
    "steps",
    [[0.01], [0.1], [1.0], [6.0], [60.0], [0.001, 0.001, 1.0], [*[0.1] * 30, 40.0]],
    ids=["100 Hz", "10 Hz", "1 Hz", "every 6 s", "every minute", "bursts", "pauses"],
)
def test_a_bag_that_begins_again_is_seen_whatever_its_rate(steps: list[float], max_gap_s: float) -> None:
    """Regular, in bursts, or with pauses; and wherever edges are placed between its messages."""
    stamps_ns = [5 * SECOND + round(1e9 * seconds) for seconds in np.cumsum(np.resize(steps, 600))]
    options = EstimatorOptions(max_odometry_gap_s=max_gap_s)
    online = OnlineEstimator(options, lambda *_, **__: None)
    said = [online.add_odometry("r", stamp_ns, [0, 0, 0, 1]) for stamp_ns in 2 * stamps_ns]
    assert said == [None] * 600 + [RejectReason.OUT_OF_ORDER_ODOMETRY] * 4 + [None] * 596
    assert online.time_jumps == 1 and online.counts().rejected == {}


@pytest.mark.parametrize("order", [[0, 0, 1, 1, 2, 2, 3, 3], [0, 2, 1, 3, 5, 4, 6, 7]], ids=["twice", "swapped"])
def test_a_bag_that_begins_again_is_seen_though_stamps_repeat_or_are_out_of_order(order: list[int]) -> None:
    """A simulation whose odometry is faster than its ``/clock``; a network that overtakes itself."""
    online = estimator("new_component")
    indices = [block + index for block in range(0, 80, 8) for index in order]
    for _ in range(2):
        for index in indices:
            feed(online, range(index, index + 1))
    snapshot = online.snapshot()
    assert online.time_jumps == 1 and snapshot.time_line.max() == 1
    assert (np.diff(snapshot.stamp_ns) > 0).sum() == len(snapshot.stamp_ns) - 2, "the two turns, each in order"
    stamps = [snapshot.stamp_ns[snapshot.time_line == line].tolist() for line in range(2)]
    assert stamps[0] == stamps[1]


def turn(source: int, target: int) -> list[float]:
    between = Rotation.from_quat(rotation(target)).inv() * Rotation.from_quat(rotation(source))
    return between.as_quat().tolist()


def closure(edge_id: int, *stamps_ns: int) -> EdgeMeasurement:
    source, target = (KeyframeReference("r", stamp_ns=stamp_ns) for stamp_ns in stamps_ns)
    return EdgeMeasurement(edge_id, source, target, turn(0, 1))


def ends(online: OnlineEstimator) -> list[tuple[int, int]]:
    """Nodes of the closures."""
    graph = online.snapshot().graph
    pairs = torch.stack((graph.source, graph.target), dim=1)
    return [tuple(pair) for pair in pairs[~graph.is_odometry].tolist()]


@pytest.fixture
def kept(solver) -> OnlineEstimator:
    """With the policy that is the default."""
    return OnlineEstimator(EstimatorOptions(keyframe_angle=0, keyframe_distance=0), solver)


JUMPS = {
    "two seconds back": (LENGTH * SECOND // 10 - 2 * SECOND, 0),
    "a bag that begins again": (0, 0),
    "after two messages an hour ahead": (LENGTH * SECOND // 10, 2),
}


@pytest.mark.parametrize(("resume_ns", "ahead"), JUMPS.values(), ids=JUMPS.keys())
def test_a_jump_begins_a_component_and_keeps_what_there_was(kept, resume_ns: int, ahead: int) -> None:
    feed(kept, range(LENGTH))
    feed(kept, range(LENGTH, LENGTH + ahead), 3600 * SECOND)
    before = kept.counts().keyframes
    kept.tick()
    feed(kept, range(LENGTH), resume_ns)
    answer = kept.tick()
    assert len(answer.keyframe_id) == before + LENGTH and answer.num_components == 2
    assert kept.time_jumps == 1
    refused = kept.counts().rejected
    assert refused.get("out_of_order_odometry", 0) == 0, "the messages that proved the jump are not lost"
    assert answer.newest_stamp_ns == resume_ns + (LENGTH - 1) * SECOND // 10
    trajectory = kept.trajectories(answer)["r"]
    assert trajectory.node.tolist() == list(range(before + LENGTH))
    now = Rotation.from_quat(kept.current_orientation("r"))
    assert (now * Rotation.from_quat(answer.world_from_body[-1]).inv()).magnitude() < 1e-9


def test_stamps_mean_the_time_line_that_has_come_last(kept) -> None:
    """A bag in a loop: the same closures again are about the keyframes of the second time."""
    edges = [closure(1, 0, 3 * SECOND), closure(2, SECOND // 20, 4 * SECOND + SECOND // 20)]
    for _ in range(3):
        feed(kept, range(LENGTH))
        assert [kept.add_edge(edge) for edge in edges] == [None, None]
        assert [kept.add_edge(edge) for edge in edges] == [RejectReason.DUPLICATE_EDGE] * 2
    assert ends(kept) == [
        (first + source, first + target) for first in (0, LENGTH, 2 * LENGTH) for source, target in ((0, 30), (0, 40))
    ]
    graph = kept.snapshot().graph
    first, *others = graph.target_from_source[~graph.is_odometry].reshape(3, 2, 4)
    for again in others:  # also what is told of the moments between keyframes
        assert torch.allclose(again, first, atol=1e-12)
    answer = kept.tick()
    assert answer.num_components == 3 and len(set(answer.stamp_ns.tolist())) == LENGTH


@pytest.mark.parametrize("max_keyframes", [1000, 12])
def test_keyframes_that_a_front_end_names_by_stamps_alone_are_others_on_each_time_line(
    solver, max_keyframes: int
) -> None:
    """Also where the first have been marginalised by the time their stamps come again."""
    options = EstimatorOptions(keyframe_source="edges", max_keyframes=max_keyframes)
    online, steps = OnlineEstimator(options, solver), range(0, LENGTH - 10, 10)
    for _ in range(3):
        feed(online, range(LENGTH))
        for step in steps:
            edge = replace(closure(step, step * SECOND // 10, step * SECOND // 10 + SECOND), kind=EdgeKind.ODOMETRY)
            said = [online.add_edge(edge) for _ in range(2)]
            assert said == [None, RejectReason.DUPLICATE_EDGE]
    counts, answer = online.counts(), online.tick()
    assert answer.num_components == 3 and len(answer.keyframe_id) + counts.marginalized == 18
    assert set(answer.time_line.tolist()) == {0, 1, 2} and (counts.marginalized > 0) == (max_keyframes < 18)
    assert counts.rejected == {"duplicate_edge": 15}


@pytest.mark.parametrize("restart", [False, True])
def test_forgotten_keyframes_of_another_time_line_keep_none_from_being_made(
    solver, restart: bool, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """Their stamps serve as ids, and after the clock went back all stamps are lower: nothing was added any more."""
    monkeypatch.setattr(room, "_REMEMBERED", 1)
    monkeypatch.setattr(room, "_REMEMBERED_AT_LEAST", 0)
    options = EstimatorOptions(keyframe_source="edges", max_keyframes=12)
    online = OnlineEstimator(options, solver)

    def drive(length: int) -> list[RejectReason | None]:
        feed(online, range(length))
        moments = range(0, length * SECOND // 10 - SECOND, SECOND)
        steps = (closure(number, moment, moment + SECOND) for number, moment in enumerate(moments))
        return [online.add_edge(replace(step, kind=EdgeKind.ODOMETRY)) for step in steps]

    assert drive(400) == [None] * 39
    assert online.snapshot().marginalized.forgotten.stamps_ns[0, 0] > 10 * SECOND
    if restart:
        online.save(tmp_path / "state.npz")
        online = OnlineEstimator(options, solver)
        online.load(tmp_path / "state.npz")
    again = replace(closure(1000, 2 * SECOND, 3 * SECOND), kind=EdgeKind.ODOMETRY)
    assert online.add_edge(again) is not None, "those of the same time line stay forgotten"
    assert drive(LENGTH) == [None] * 5
    snapshot = online.snapshot()
    made = np.concatenate((snapshot.time_line, snapshot.marginalized.keyframes.time_line))
    assert int((made == 1).sum()) == 6 and online.counts().keyframes <= 12


def test_a_stamp_that_the_present_time_line_does_not_cover_means_an_earlier_one(kept) -> None:
    feed(kept, range(LENGTH), 1000 * SECOND)
    feed(kept, range(LENGTH), 100 * SECOND)
    present, earlier = 103 * SECOND, 1003 * SECOND
    assert kept.add_edge(closure(1, earlier, present)) is None
    assert kept.add_edge(closure(2, present, present + 30 * SECOND)) is None, "not there yet: it waits"
    assert kept.add_edge(closure(3, present, 90 * SECOND)) is RejectReason.STAMP_OUT_OF_RANGE
    assert ends(kept) == [(30, LENGTH + 30)]


def test_edges_wait_while_it_is_open_which_time_line_their_stamps_are_of(kept) -> None:
    """Odometry shows the jump with its fifth message; closures come before that."""
    feed(kept, range(LENGTH))
    feed(kept, range(3))
    assert kept.add_edge(closure(1, 0, SECOND // 10)) is None
    assert ends(kept) == [] and kept.counts().pending == 1
    feed(kept, range(3, 20))
    assert ends(kept) == [(LENGTH, LENGTH + 1)]
    feed(kept, range(2))  # two strays …
    assert kept.add_edge(closure(2, 0, SECOND)) is None
    assert kept.counts().pending == 1
    feed(kept, range(20, 22))  # … and time goes on
    assert ends(kept) == [(LENGTH, LENGTH + 1), (LENGTH, LENGTH + 10)]
    feed(kept, range(1))  # one stray alone is nothing to wait for: perhaps no odometry comes any more
    assert kept.add_edge(closure(3, 0, SECOND // 2)) is None
    assert ends(kept)[-1] == (LENGTH, LENGTH + 5) and kept.counts().pending == 0


@pytest.mark.parametrize("policy", ["new_component", "ignore", "error"])
def test_what_waited_at_the_jump(solver, policy: str) -> None:
    """What is just ahead of the last message is tied to it; what waits for more odometry of then is refused."""
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, on_time_jump=policy)
    online = OnlineEstimator(options, solver)
    last_ns = (LENGTH - 1) * SECOND // 10
    feed(online, range(LENGTH))
    assert online.add_edge(closure(1, 0, last_ns + SECOND // 20)) is None
    assert online.add_edge(closure(2, 0, last_ns + SECOND)) is None
    feed(online, range(10))
    begins = policy == "new_component"
    assert ends(online) == ([(0, LENGTH - 1)] if begins else [])
    assert online.counts().pending == (0 if begins else 2)
    assert online.counts().rejected.get("stamp_out_of_range", 0) == int(begins)


def test_what_waited_for_another_robot_at_the_jump_is_not_about_the_new_time(kept) -> None:
    """It had been tied to where the robot was at that stamp the second time: a false closure between robots."""

    def other(indices: range) -> None:
        for index in indices:
            kept.add_odometry("other", index * SECOND // 10, rotation(index))

    source, target = KeyframeReference("r", stamp_ns=3 * SECOND), KeyframeReference("other", stamp_ns=4 * SECOND)
    between = EdgeMeasurement(1, source, target, turn(30, 40))
    feed(kept, range(LENGTH))
    other(range(35))
    assert kept.add_edge(between) is None and kept.counts().pending == 1
    feed(kept, range(LENGTH))
    assert kept.counts().pending == 0 and kept.counts().rejected == {"stamp_out_of_range": 1}
    other(range(35, LENGTH))
    assert ends(kept) == []
    assert kept.add_edge(between) is None, "what is sent from now on means the new time"
    snapshot = kept.snapshot()
    ((node, _),) = ends(kept)
    assert (snapshot.keyframe_id[node], snapshot.time_line[node]) == (LENGTH + 30, 1)


def test_waiting_edges_time_out_on_the_new_time_line(solver) -> None:
    options = EstimatorOptions(keyframe_angle=0, keyframe_distance=0, pending_timeout_s=3.0)
    online = OnlineEstimator(options, solver)
    feed(online, range(LENGTH), 1000 * SECOND)
    online.add_edge(EdgeMeasurement(1, KeyframeReference("r", 0), KeyframeReference("r", 5000), turn(0, 1)))
    feed(online, range(20))
    assert online.counts().pending == 1
    feed(online, range(20, 50))
    assert online.counts().pending == 0


def test_the_clock_begins_a_time_line_for_the_robots_that_are_ahead_of_it(kept) -> None:
    feed(kept, range(LENGTH), 100 * SECOND)
    kept.add_odometry("slow", 10 * SECOND, rotation(0))
    kept.clock_went_back(9 * SECOND + SECOND // 2)
    kept.clock_went_back(9 * SECOND + SECOND // 2)
    assert kept.time_jumps == 1
    kept.add_odometry("slow", 11 * SECOND, rotation(1))
    feed(kept, range(LENGTH), 100 * SECOND)  # no run of late messages is needed
    answer = kept.tick()
    assert answer.num_components == 3 and len(answer.keyframe_id) == 2 * LENGTH + 2
    assert answer.time_line.tolist() == [0] * LENGTH + [0, 0] + [1] * LENGTH
    assert kept.counts().rejected == {}


@pytest.mark.parametrize("restart", [False, True])
def test_odometry_that_the_clock_overtakes_belongs_to_the_time_before(restart: bool, tmp_path: Path) -> None:
    online = estimator("new_component")
    feed(online, range(40))
    online.clock_went_back(0)
    assert online.add_edge(closure(1, 2 * SECOND, 5 * SECOND)) is None
    if restart:
        online.save(tmp_path / "state.npz")
        online = estimator("new_component")
        online.load(tmp_path / "state.npz")
    assert feed(online, range(40, LENGTH)) == [None] * (LENGTH - 40)  # they were under way
    assert online.counts().pending == 1, "which of the two times its stamps mean is not known yet"
    feed(online, range(LENGTH))
    snapshot = online.snapshot()
    assert snapshot.time_line.tolist() == [0] * LENGTH + [1] * LENGTH
    assert int(snapshot.graph.is_odometry.sum()) == 2 * (LENGTH - 1)
    assert online.counts().pending == 0 and ends(online) == [(LENGTH + 20, LENGTH + 50)]
    assert online.time_jumps == (0 if restart else 1) and online.counts().rejected == {}


def test_with_reset_odometry_that_the_clock_overtakes_is_forgotten_once() -> None:
    """What was under way belongs to the time before: it made a graph of its own, which was then forgotten as well."""
    online, once = estimator("reset"), estimator("reset")
    feed(online, range(40))
    online.clock_went_back(0, LENGTH * SECOND // 10)
    assert feed(online, range(40, LENGTH)) == [RejectReason.OUT_OF_ORDER_ODOMETRY] * (LENGTH - 40)
    assert online.add_edge(closure(1, 0, 2 * SECOND)) is None
    feed(online, range(70))  # beyond the stamps of then
    assert once.add_edge(closure(1, 0, 2 * SECOND)) is None
    feed(once, range(70))
    assert graph(online) == graph(once) and ends(online) == ends(once) == [(0, 20)]
    assert (online.time_jumps, online.generation) == (1, 1)


def test_with_reset_odometry_of_another_clock_goes_on() -> None:
    """Its stamps are none that the clock that went back has shown."""
    online = estimator("reset")
    feed(online, range(40), 1000 * SECOND)
    online.clock_went_back(0, 4 * SECOND)
    assert feed(online, range(40, LENGTH), 1000 * SECOND) == [None] * (LENGTH - 40)
    assert online.counts().keyframes == LENGTH - 40


@pytest.mark.parametrize("policy", ["new_component", "reset"])
def test_a_clock_that_goes_back_by_less_than_a_jump_changes_nothing(policy: str) -> None:
    """As where two publish it; the stamps of another computer's odometry are ahead of it by more than a jump."""
    online = estimator(policy)
    feed(online, range(LENGTH))
    online.clock_went_back(2 * SECOND - 10**6, 2 * SECOND)
    assert online.time_jumps == 0 and online.counts().keyframes == LENGTH
    assert online.add_edge(closure(1, 0, 2 * SECOND)) is None
    assert ends(online) == [(0, 20)], "which time its stamps are of is clear"
    online.clock_went_back(0, 2 * SECOND)
    assert online.time_jumps == 1


@pytest.mark.parametrize("max_lead_s", [60.0, 0.0, 1e6])
def test_odometry_that_does_not_follow_the_clock_goes_on(max_lead_s: float) -> None:
    """Also where any stamp is believed: edges by stamp had then waited for good."""
    online = estimator("new_component")
    online.set_options(replace(online.options, max_stamp_lead_s=max_lead_s))
    feed(online, range(40))
    online.clock_went_back(0)
    assert online.add_edge(closure(1, 2 * SECOND, 3 * SECOND)) is None and online.counts().pending == 1
    feed(online, range(40, 700))  # a minute and six seconds: its stamps are another clock's
    assert online.counts().pending == 0 and ends(online) == [(20, 30)]
    assert not online.snapshot().time_line.any()


@given(late=st.lists(st.tuples(st.integers(0, LENGTH - 1), st.integers(0, 10_000)), max_size=40))
def test_stray_old_messages_among_good_ones_change_nothing(late: list[tuple[int, int]]) -> None:
    """Up to four in a row whatever their stamps; a good message in between starts the count anew."""
    clean, mixed = estimator("new_component"), estimator("new_component")
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


@pytest.mark.parametrize("policy", ["new_component", "reset"])
@pytest.mark.parametrize("restart", [False, True])
def test_another_policy_applies_to_a_jump_that_was_refused(policy: str, restart: bool, tmp_path: Path) -> None:
    online = estimator("error")
    feed(online, range(LENGTH))
    feed(online, range(10))
    if restart:
        online.save(tmp_path / "state.npz")
        online = estimator(policy)
        online.load(tmp_path / "state.npz")
    else:
        online.set_options(replace(online.options, on_time_jump=policy))
    assert online.counts().keyframes == LENGTH
    feed(online, range(10, 30))
    assert online.counts().keyframes == (20 if policy == "reset" else LENGTH + 20)
    assert not online.counts().time_is_back and feed(online, range(30, 33)) == [None] * 3


def test_a_small_step_back_is_only_out_of_order() -> None:
    online = estimator("new_component")
    feed(online, range(LENGTH))
    assert set(feed(online, range(LENGTH - 9, LENGTH - 1))) == {RejectReason.OUT_OF_ORDER_ODOMETRY}
    assert online.time_jumps == 0


def test_the_clock_tells_it_at_once_but_only_what_odometry_has_not() -> None:
    online = estimator("reset")
    feed(online, range(LENGTH))
    online.clock_went_back(5 * SECOND + SECOND // 2)  # odometry is at 5.9 s
    assert online.counts().keyframes == LENGTH
    online.clock_went_back(0)
    assert online.counts().keyframes == 0 and online.time_jumps == 1
    feed(online, range(3))
    online.clock_went_back(0)
    assert online.counts().keyframes == 3 and online.time_jumps == 1
