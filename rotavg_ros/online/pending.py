"""Edges that came before what they refer to: a bounded waiting room."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference


@dataclass(slots=True)
class _Waiting:
    edge: EdgeMeasurement
    waits_for: KeyframeReference
    since_ns: int | None  # in data time; None while no data time is known


class PendingEdges:
    """Each waiting edge waits for one of its ends. When there are more than ``capacity`` the oldest has to go.

    Attributes:
        fingerprints: of those that wait.
        by_robot: how many wait for each robot.
    """

    def __init__(self, capacity: int, timeout_ns: int) -> None:
        self._capacity = capacity
        self._timeout_ns = timeout_ns
        self._serial = 0
        self._waiting: dict[int, _Waiting] = {}  # by serial number, so in order of arrival
        self.fingerprints: set[int] = set()
        self.by_robot: Counter[str] = Counter()
        self._by_keyframe: dict[tuple[str, int], dict[int, None]] = {}
        self._by_stamp: dict[str, list[tuple[int, int]]] = {}  # per robot, ascending (stamp, serial)

    def __len__(self) -> int:
        return len(self._waiting)

    def __iter__(self) -> Iterator[EdgeMeasurement]:
        return (waiting.edge for waiting in self._waiting.values())

    def longest(self, data_time_ns: int | None) -> tuple[KeyframeReference, int] | None:
        """What the first edge to come waits for, and for how many nanoseconds of data time; None if none waits."""
        first = next(iter(self._waiting.values()), None)
        if first is None:
            return None
        if data_time_ns is None or first.since_ns is None:
            return first.waits_for, 0
        return first.waits_for, data_time_ns - first.since_ns

    def add(
        self, edge: EdgeMeasurement, waits_for: KeyframeReference, data_time_ns: int | None
    ) -> EdgeMeasurement | None:
        """Let an edge wait for one of its ends; returns the edge that had to go for it, if any."""
        evicted = None
        if len(self._waiting) >= self._capacity:
            evicted = self._remove(next(iter(self._waiting)))
        self._serial += 1
        self._waiting[self._serial] = _Waiting(edge, waits_for, data_time_ns)
        self.fingerprints.add(edge.fingerprint())
        self.by_robot[waits_for.robot] += 1
        if waits_for.keyframe_id is not None:
            key = (waits_for.robot, waits_for.keyframe_id)
            self._by_keyframe.setdefault(key, {})[self._serial] = None
        else:
            insort(self._by_stamp.setdefault(waits_for.robot, []), (_stamp(waits_for), self._serial))
        return evicted

    def pop_keyframe(self, robot: str, keyframe_id: int) -> list[EdgeMeasurement]:
        """Take out what waits for a keyframe."""
        return [self._remove(serial) for serial in list(self._by_keyframe.get((robot, keyframe_id), ()))]

    def pop_until(self, robot: str, stamp_ns: int) -> list[EdgeMeasurement]:
        """Take out what waits for a moment of a robot not later than the stamp."""
        stamps = self._by_stamp.get(robot)
        if not stamps or stamps[0][0] > stamp_ns:
            return []
        ready = stamps[: bisect_right(stamps, (stamp_ns, self._serial))]
        return [self._remove(serial) for _, serial in ready]

    def pop_expired(self, data_time_ns: int) -> list[EdgeMeasurement]:
        """Take out what has waited for longer than the timeout in data time."""
        expired = []
        for serial, waiting in self._waiting.items():
            if waiting.since_ns is None:
                waiting.since_ns = data_time_ns  # the clock starts with the first data
            elif data_time_ns - waiting.since_ns <= self._timeout_ns:
                break
            else:
                expired.append(serial)
        return [self._remove(serial) for serial in expired]

    def _remove(self, serial: int) -> EdgeMeasurement:
        waiting = self._waiting.pop(serial)
        self.fingerprints.discard(waiting.edge.fingerprint())
        reference = waiting.waits_for
        self.by_robot[reference.robot] -= 1
        if not self.by_robot[reference.robot]:
            del self.by_robot[reference.robot]
        if reference.keyframe_id is not None:
            key = (reference.robot, reference.keyframe_id)
            del self._by_keyframe[key][serial]
            if not self._by_keyframe[key]:
                del self._by_keyframe[key]
        else:
            stamps = self._by_stamp[reference.robot]
            del stamps[bisect_right(stamps, (_stamp(reference), serial)) - 1]
            if not stamps:
                del self._by_stamp[reference.robot]
        return waiting.edge


def _stamp(reference: KeyframeReference) -> int:
    assert reference.stamp_ns is not None  # a reference without an id has a stamp (check_edge)
    return reference.stamp_ns
