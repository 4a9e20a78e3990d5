"""Which closures may be passed on to a back end: those that answers believe, each once; later changes are reported."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import cache
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.answer.answer import Answer
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.online.measurements import MAX_ID, EdgeMeasurement
from rotavg_ros.view_graph import EdgeKind

# A sender's name for an edge: the source's robot, and the edge's id.
EdgeName = tuple[str, int]
# Most closures that wait for a verdict, and most whose later verdicts are followed; beyond, the oldest are forgotten.
_MOST_WAITING, _MOST_FOLLOWED = 100_000, 1_000_000

_Item = TypeVar("_Item")


@dataclass(frozen=True)
class Decision(Generic[_Item]):
    """What an answer changes.

    Attributes:
        passed: items handed in with closures that are believed now, in the order in which they came.
        revoked: rows of the answer's edges that were let pass and are now judged false.
        reinstated: rows of edges that were revoked and are believed again.
        shares_names: whether several closures of the answer have one name, and one of them, at least, was handed in.
    """

    passed: list[_Item] = field(default_factory=list)
    revoked: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    reinstated: NDArray[np.int64] = field(default_factory=lambda: np.empty(0, dtype=np.int64))
    shares_names: bool = False


@dataclass
class _Waiting(Generic[_Item]):
    since: float
    items: list[_Item] = field(default_factory=list)
    measurements: set[int] = field(default_factory=set)


class ClosureFilter(Generic[_Item]):
    """Closures by the names that their senders gave them. Not thread-safe.

    Once it is old enough, a closure passes with the first answer that contains and believes it; one that is judged
    false goes on waiting. Items of type ``_Item`` stand for what is to be sent on.

    Attributes:
        dropped: number of closures forgotten because too many waited.
    """

    def __init__(self, *, newest_counts: bool = False) -> None:
        """Begin with nothing.

        Args:
            newest_counts: of several measurements with one name the newest decides, since the sender means it to
                replace those before; otherwise all of them have to be believed.
        """
        self._newest_counts = newest_counts
        self.dropped = 0
        self._waiting: dict[int, _Waiting[_Item]] = {}
        self._believed: dict[int, bool] = {}  # of those that were let pass: whether they still are

    def __len__(self) -> int:
        """Number of closures that wait."""
        return len(self._waiting)

    def take(self, name: EdgeName, item: _Item, now: float, measurement: int = 0) -> None:
        """Take a closure, or another measurement of the same name.

        Args:
            name: the sender's.
            item: to be handed out when it passes.
            now: seconds.
            measurement: tells it from others of the name, see :meth:`waits`.
        """
        key = _key(name)
        if key not in self._waiting and len(self._waiting) >= _MOST_WAITING:
            del self._waiting[next(iter(self._waiting))]
            self.dropped += 1
        waiting = self._waiting.setdefault(key, _Waiting(now))
        waiting.items.append(item)
        waiting.measurements.add(measurement)

    def forget_all_but(self, keys: NDArray[np.uint64]) -> None:
        """Forget the closures that wait and have none of these :func:`closure_keys`: no answer will tell of them."""
        waiting = np.fromiter(self._waiting, dtype=np.uint64, count=len(self._waiting))
        for key in waiting[~np.isin(waiting, keys)].tolist():
            del self._waiting[key]

    def waits(self, name: EdgeName, measurement: int) -> bool:
        """Whether this very measurement waits."""
        waiting = self._waiting.get(_key(name))
        return waiting is not None and measurement in waiting.measurements

    def knows(self, name: EdgeName) -> bool:
        """Whether a closure of this name waits or has passed."""
        return self._knows(_key(name))

    def _knows(self, key: int) -> bool:
        return key in self._waiting or key in self._believed

    def passes(self, name: EdgeName) -> bool:
        """Whether a closure was let pass and is still believed."""
        return self._believed.get(_key(name), False)

    def decide(self, answer: Answer, now: float, delay_s: float) -> Decision[_Item]:
        """What the last answer changes for closures that came ``delay_s`` ago or earlier."""
        rows, keys = _closures(answer)
        order = np.argsort(keys, kind="stable")
        unique, first = np.unique(keys[order], return_index=True)
        outlier = answer.outlier[rows][order]
        if not len(first):
            is_false = np.empty(0, dtype=bool)
        elif self._newest_counts:
            is_false = outlier[np.append(first[1:], len(rows)) - 1]
        else:
            is_false = np.logical_or.reduceat(outlier, first)
        is_shared = np.diff(np.append(first, len(rows))) > 1
        shares_names = any(self._knows(key) for key in unique[is_shared].tolist())
        revoked, reinstated = self._follow(unique, is_false, rows[order], first)
        return Decision(self._let_pass(unique, is_false, now - delay_s), revoked, reinstated, shares_names)

    def _let_pass(self, unique: NDArray[np.uint64], is_false: NDArray[np.bool_], until: float) -> list[_Item]:
        passed: list[_Item] = []
        keys = [key for key, waiting in self._waiting.items() if waiting.since <= until]
        found, place = _found(np.array(keys, dtype=np.uint64), unique)
        for key, is_known, at in zip(keys, found.tolist(), place.tolist(), strict=True):
            if is_known and not is_false[at]:
                passed += self._waiting.pop(key).items
                self._believed[key] = True
        for key in list(self._believed)[: max(0, len(self._believed) - _MOST_FOLLOWED)]:
            del self._believed[key]
        return passed

    def _follow(
        self,
        unique: NDArray[np.uint64],
        is_false: NDArray[np.bool_],
        rows: NDArray[np.int64],
        first: NDArray[np.int64],
    ) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of edges that were let pass and whose verdict has changed: to false, and back."""
        keys = np.fromiter(self._believed, dtype=np.uint64, count=len(self._believed))
        believed = np.fromiter(self._believed.values(), dtype=bool, count=len(keys))
        found, place = _found(keys, unique)
        now_believed = believed.copy()
        now_believed[found] = ~is_false[place[found]]
        changed = now_believed != believed
        for key, is_believed in zip(keys[changed].tolist(), now_believed[changed].tolist(), strict=True):
            self._believed[key] = is_believed
        ends = np.append(first[1:], len(rows))
        revoked, reinstated = (
            [rows[first[at] : ends[at]] for at in place[changed & (now_believed == back)].tolist()]
            for back in (False, True)
        )
        return _joined(revoked), _joined(reinstated)


def closure_keys(snapshot: GraphSnapshot, pending: Iterable[EdgeMeasurement]) -> NDArray[np.uint64]:
    """Names, as numbers, of the closures in a graph, and of the edges that wait to enter it."""
    graph = snapshot.graph
    rows, source = np.flatnonzero((graph.kind == EdgeKind.LOOP_CLOSURE).numpy()), graph.source.numpy()
    inside = _keys_of(rows, snapshot.edge_id, source, snapshot)
    waiting = [_key((edge.source.robot, edge.edge_id)) for edge in pending]
    return np.append(inside, np.array(waiting, dtype=np.uint64))


def _closures(answer: Answer) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
    """Rows of the closures that were part of the answer's solve, and their names as numbers."""
    rows = np.flatnonzero((answer.kind == EdgeKind.LOOP_CLOSURE) & ~answer.waits)
    return rows, _keys_of(rows, answer.edge_id, answer.source, answer)


def _keys_of(
    rows: NDArray[np.int64], edge_id: NDArray[np.uint64], source: NDArray[np.int64], keyframes: Answer | GraphSnapshot
) -> NDArray[np.uint64]:
    """``(n,)`` names of some edges, as numbers."""
    robot_keys = np.array([_robot_key(robot) for robot in keyframes.robots], dtype=np.uint64)
    if not len(rows):
        return np.empty(0, dtype=np.uint64)
    return edge_id[rows] ^ robot_keys[keyframes.keyframe_robot[source[rows]]]


def _found(keys: NDArray[np.uint64], unique: NDArray[np.uint64]) -> tuple[NDArray[np.bool_], NDArray[np.int64]]:
    """Which keys are in an ascending array, and where."""
    if not len(unique):
        return np.zeros(len(keys), dtype=bool), np.zeros(len(keys), dtype=np.int64)
    place = np.minimum(np.searchsorted(unique, keys), len(unique) - 1)
    return unique[place] == keys, place


def _joined(rows: list[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.sort(np.concatenate(rows)) if rows else np.empty(0, dtype=np.int64)


def _key(name: EdgeName) -> int:
    robot, edge_id = name
    return (edge_id & MAX_ID) ^ _robot_key(robot)


@cache
def _robot_key(robot: str) -> int:
    """64 bits that tell robots apart: in practice, edges of two robots never share a key."""
    return int.from_bytes(hashlib.blake2b(robot.encode("utf-8", "surrogatepass"), digest_size=8).digest(), "little")
