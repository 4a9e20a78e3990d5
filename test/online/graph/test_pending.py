from __future__ import annotations

from rotavg_ros.online import EdgeMeasurement, KeyframeReference
from rotavg_ros.online.graph.pending import PendingEdges

IDENTITY = (0.0, 0.0, 0.0, 1.0)


def edge(edge_id: int, source: KeyframeReference, target: KeyframeReference) -> EdgeMeasurement:
    return EdgeMeasurement(edge_id, source, target, IDENTITY)


def by_id(edge_id: int, keyframe_id: int) -> tuple[EdgeMeasurement, KeyframeReference]:
    reference = KeyframeReference("r", keyframe_id)
    return edge(edge_id, reference, KeyframeReference("r", 0)), reference


def by_stamp(edge_id: int, stamp_ns: int) -> tuple[EdgeMeasurement, KeyframeReference]:
    reference = KeyframeReference("r", stamp_ns=stamp_ns)
    return edge(edge_id, reference, KeyframeReference("r", 0)), reference


def ids(edges) -> list[int]:
    return [e.edge_id for e in edges]


def test_released_by_keyframe_and_by_stamp():
    pending = PendingEdges(10, 1000)
    pending.add(*by_id(1, 7), None)
    pending.add(*by_id(2, 7), None)
    pending.add(*by_stamp(3, 50), None)
    pending.add(*by_stamp(4, 40), None)
    assert pending.pop_keyframe("r", 8) == [] and pending.pop_keyframe("other", 7) == []
    assert ids(pending.pop_keyframe("r", 7)) == [1, 2]
    assert pending.pop_until("r", 39) == [] and pending.pop_until("other", 99) == []
    assert ids(pending.pop_until("r", 40)) == [4]
    assert ids(pending) == [3] and len(pending) == 1


def test_the_oldest_goes_when_it_is_full():
    pending = PendingEdges(2, 1000)
    assert pending.add(*by_id(1, 7), None) is None
    assert pending.add(*by_stamp(2, 10), None) is None
    assert pending.add(*by_stamp(3, 11), None).edge_id == 1
    assert pending.add(*by_stamp(4, 10), None).edge_id == 2
    assert ids(pending.pop_until("r", 99)) == [4, 3]
    assert len(pending) == 0 and not pending._by_keyframe and not pending._by_stamp


def test_the_timeout_runs_in_data_time_and_starts_with_it():
    pending = PendingEdges(10, 100)
    pending.add(*by_id(1, 7), None)
    assert pending.pop_expired(10**18) == []  # the first data there is
    pending.add(*by_id(2, 7), 10**18 + 50)
    assert pending.pop_expired(10**18 + 100) == []
    assert ids(pending.pop_expired(10**18 + 101)) == [1]
    assert ids(pending.pop_expired(10**18 + 151)) == [2]
    assert len(pending) == 0
