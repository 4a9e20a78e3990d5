"""Edges that came before what they refer to: a bounded waiting room."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections import Counter
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, replace

from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference


@dataclass(slots=True)
class Waiting:
    """An edge that waits.

    Attributes:
        edge: the edge.
        waits_for: the end that is not there yet.
        timed_by: the robot in whose data time the wait counts.
        since_ns: start of the wait in that robot's data time; None while it is not known.
        is_undecided: whether it waits until it is known to which time line the end's stamp belongs.
    """

    edge: EdgeMeasurement
    waits_for: KeyframeReference
    timed_by: str
    since_ns: int | None
    is_undecided: bool = False


class PendingEdges:
    """Each waiting edge waits for one of its ends. When there are more than ``capacity``, the oldest is removed.

    Undecided ones wait until it is known to which time line of a robot their stamps belong.

    Attributes:
        by_robot: number of edges that wait for each robot.
    """

    def __init__(self, capacity: int, timeout_ns: int) -> None:
        self._capacity = capacity
        self._timeout_ns = timeout_ns
        self._serial = 0
        self._waiting: dict[int, Waiting] = {}  # by serial number, so in order of arrival
        self._fingerprints: set[int] = set()
        self.by_robot: Counter[str] = Counter()
        self._by_keyframe: dict[tuple[str, int], dict[int, None]] = {}
        self._by_stamp: dict[str, list[tuple[int, int]]] = {}  # per robot, ascending (stamp, serial)
        self._undecided: dict[str, dict[int, None]] = {}  # per robot
        self._timed_by: dict[str, dict[int, None]] = {}  # per robot, in order of arrival

    def __len__(self) -> int:
        return len(self._waiting)

    def __contains__(self, edge: EdgeMeasurement) -> bool:
        """Whether the edge, or a retransmission of it, waits."""
        return bool(self._fingerprints) and edge.fingerprint() in self._fingerprints

    def __iter__(self) -> Iterator[EdgeMeasurement]:
        return (waiting.edge for waiting in self._waiting.values())

    def longest(self, now_ns: Callable[[str], int | None]) -> tuple[KeyframeReference, int] | None:
        """What the longest-waiting edge waits for, and for how many nanoseconds; None if none waits.

        Args:
            now_ns: data time of a robot; None while it is not known.
        """
        if not self._waiting:
            return None
        oldest = ((next(iter(serials)), now_ns(robot)) for robot, serials in self._timed_by.items())
        waited_ns, serial = max((self._waited_ns(serial, now), -serial) for serial, now in oldest)
        return self._waiting[-serial].waits_for, waited_ns

    def _waited_ns(self, serial: int, now_ns: int | None) -> int:
        since_ns = self._waiting[serial].since_ns
        return 0 if now_ns is None or since_ns is None else now_ns - since_ns

    def add(self, waiting: Waiting) -> EdgeMeasurement | None:
        """Let an edge wait for one of its ends; returns the edge removed to make room for it, if any."""
        evicted = None
        if len(self._waiting) >= self._capacity:
            evicted = self._remove(next(iter(self._waiting)))
        self._add(waiting)
        return evicted

    def _add(self, waiting: Waiting) -> None:
        self._serial += 1
        self._waiting[self._serial] = waiting
        self._fingerprints.add(waiting.edge.fingerprint())
        reference = waiting.waits_for
        self.by_robot[reference.robot] += 1
        self._timed_by.setdefault(waiting.timed_by, {})[self._serial] = None
        if waiting.is_undecided:
            self._undecided.setdefault(reference.robot, {})[self._serial] = None
        elif reference.keyframe_id is not None:
            self._by_keyframe.setdefault((reference.robot, reference.keyframe_id), {})[self._serial] = None
        else:
            insort(self._by_stamp.setdefault(reference.robot, []), (_stamp(reference), self._serial))

    def pop_undecided(self, robot: str) -> list[EdgeMeasurement]:
        """Take out the edges that have waited for a decision about a robot's time line."""
        return [self._remove(serial) for serial in list(self._undecided.get(robot, ()))]

    def pop_of_time_line(self, robot: str) -> list[EdgeMeasurement]:
        """Take out the edges about a moment of a robot on a time line that has ended, whichever end they wait for.

        Undecided ones stay: they may be about the next time line.
        """
        decided = ((serial, waiting.edge) for serial, waiting in self._waiting.items() if not waiting.is_undecided)
        ended = [serial for serial, edge in decided if edge.has_moment_of(robot)]
        return [self._remove(serial) for serial in ended]

    def restart_timeouts(self, robot: str) -> None:
        """A robot's data time went back: the timeouts that count in it start again."""
        for serial in self._timed_by.get(robot, ()):
            self._waiting[serial].since_ns = None

    def pop_keyframe(self, robot: str, keyframe_id: int) -> list[EdgeMeasurement]:
        """Take out the edges that wait for a keyframe."""
        return [self._remove(serial) for serial in list(self._by_keyframe.get((robot, keyframe_id), ()))]

    def pop_moment(self, robot: str, stamp_ns: int) -> list[EdgeMeasurement]:
        """Take out the edges that wait for exactly this moment of a robot."""
        stamps = self._by_stamp.get(robot, [])
        first, behind = bisect_left(stamps, (stamp_ns, 0)), bisect_right(stamps, (stamp_ns, self._serial))
        return [self._remove(serial) for _, serial in stamps[first:behind]]

    def pop_until(self, robot: str, stamp_ns: int) -> list[EdgeMeasurement]:
        """Take out the edges that wait for a moment of a robot not later than the stamp."""
        stamps = self._by_stamp.get(robot)
        if not stamps or stamps[0][0] > stamp_ns:
            return []
        ready = stamps[: bisect_right(stamps, (stamp_ns, self._serial))]
        return [self._remove(serial) for _, serial in ready]

    def pop_expired(self, robot: str, data_time_ns: int) -> list[EdgeMeasurement]:
        """Take out the edges that have waited for longer than the timeout in a robot's data time."""
        expired = []
        for serial in self._timed_by.get(robot, ()):
            waiting = self._waiting[serial]
            if waiting.since_ns is None:
                waiting.since_ns = data_time_ns  # the clock starts with the first data
            elif data_time_ns - waiting.since_ns <= self._timeout_ns:
                break
            else:
                expired.append(serial)
        return [self._remove(serial) for serial in expired]

    def _remove(self, serial: int) -> EdgeMeasurement:
        waiting = self._waiting.pop(serial)
        self._fingerprints.discard(waiting.edge.fingerprint())
        del self._timed_by[waiting.timed_by][serial]
        if not self._timed_by[waiting.timed_by]:
            del self._timed_by[waiting.timed_by]
        reference = waiting.waits_for
        self.by_robot[reference.robot] -= 1
        if not self.by_robot[reference.robot]:
            del self.by_robot[reference.robot]
        if waiting.is_undecided:
            del self._undecided[reference.robot][serial]
            if not self._undecided[reference.robot]:
                del self._undecided[reference.robot]
        elif reference.keyframe_id is not None:
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

    def waiting(self) -> list[Waiting]:
        """Copies of what waits, in order of arrival."""
        return [replace(waiting) for waiting in self._waiting.values()]

    def take(self, waiting: Iterable[Waiting]) -> None:
        """Let the edges that :meth:`waiting` returned wait again."""
        for each in waiting:
            self._add(each)


def _stamp(reference: KeyframeReference) -> int:
    assert reference.stamp_ns is not None  # a reference without an id has a stamp (checked_edge)
    return reference.stamp_ns
