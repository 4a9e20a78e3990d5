from __future__ import annotations

from rotavg_ros.online import EdgeMeasurement, KeyframeReference
from rotavg_ros.online.graph.pending import PendingEdges, Waiting

IDENTITY = (0.0, 0.0, 0.0, 1.0)


def edge(edge_id: int, source: KeyframeReference, target: KeyframeReference) -> EdgeMeasurement:
    return EdgeMeasurement(edge_id, source, target, IDENTITY)


def by_id(edge_id: int, keyframe_id: int, since_ns: int | None = None, robot: str = "r") -> Waiting:
    reference = KeyframeReference(robot, keyframe_id)
    return Waiting(edge(edge_id, reference, KeyframeReference(robot, 0)), reference, robot, since_ns)


def by_stamp(edge_id: int, stamp_ns: int) -> Waiting:
    reference = KeyframeReference("r", stamp_ns=stamp_ns)
    return Waiting(edge(edge_id, reference, KeyframeReference("r", 0)), reference, "r", None)


def ids(edges) -> list[int]:
    return [e.edge_id for e in edges]


def test_released_by_keyframe_and_by_stamp():
    pending = PendingEdges(10, 1000)
    pending.add(by_id(1, 7))
    pending.add(by_id(2, 7))
    pending.add(by_stamp(3, 50))
    pending.add(by_stamp(4, 40))
    assert pending.pop_keyframe("r", 8) == [] and pending.pop_keyframe("other", 7) == []
    assert ids(pending.pop_keyframe("r", 7)) == [1, 2]
    assert pending.pop_until("r", 39) == [] and pending.pop_until("other", 99) == []
    assert ids(pending.pop_until("r", 40)) == [4]
    assert ids(pending) == [3] and len(pending) == 1


def test_the_oldest_goes_when_it_is_full():
    pending = PendingEdges(2, 1000)
    assert pending.add(by_id(1, 7)) is None
    assert pending.add(by_stamp(2, 10)) is None
    assert pending.add(by_stamp(3, 11)).edge_id == 1
    assert pending.add(by_stamp(4, 10)).edge_id == 2
    assert ids(pending.pop_until("r", 99)) == [4, 3]
    assert len(pending) == 0 and not pending._by_keyframe and not pending._by_stamp


def test_the_timeout_runs_in_data_time_and_starts_with_it():
    pending = PendingEdges(10, 100)
    pending.add(by_id(1, 7))
    assert pending.pop_expired("r", 10**18) == []  # the first data there is
    pending.add(by_id(2, 7, 10**18 + 50))
    assert pending.pop_expired("r", 10**18 + 100) == []
    assert ids(pending.pop_expired("r", 10**18 + 101)) == [1]
    assert ids(pending.pop_expired("r", 10**18 + 151)) == [2]
    assert len(pending) == 0


def test_each_robot_has_its_own_time():
    pending = PendingEdges(10, 100)
    pending.add(by_id(1, 7, 50, "slow"))
    pending.add(by_id(2, 7, 9000, "ahead"))
    pending.add(by_id(3, 7, 60, "slow"))
    now_ns = {"slow": 90, "ahead": 9010}
    assert pending.longest(now_ns.get) == (KeyframeReference("slow", 7), 40)
    assert pending.pop_expired("ahead", 9100) == [] and ids(pending.pop_expired("ahead", 9101)) == [2]
    pending.restart_timeouts("slow")
    assert pending.longest(now_ns.get) == (KeyframeReference("slow", 7), 0)
    assert pending.pop_expired("slow", 500) == [] and ids(pending.pop_expired("slow", 601)) == [1, 3]
    assert pending.longest(now_ns.get) is None and not pending._timed_by
