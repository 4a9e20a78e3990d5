"""What senders of pose graphs have in common: they send edges between their own keyframes again and again."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Mapping
from typing import Any

from rotavg_ros.inputs.fields import Key, edge_id_of, target_from_source, to_tuple, to_vector
from rotavg_ros.inputs.records import EdgeRecord, Source
from rotavg_ros.online import EdgeMeasurement, KeyframeReference, RejectReason, quaternion
from rotavg_ros.online.graph.fingerprints import Fingerprints
from rotavg_ros.online.measurements import MAX_ID, RejectedInputError, contradict
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.view_graph import EdgeKind

# Most edges remembered as seen; beyond, they are forgotten, so that nonsense cannot fill the memory. The estimator
# recognises repetitions as well, at a higher cost.
_MOST_REMEMBERED = 1_000_000


class ForeignGraph:
    """Edges by keyframe id; each measurement passes once, however often the sender repeats its graph.

    An edge that the estimator has given up, such as a closure whose keyframe came too late, passes once more.

    A repeated closure with another rotation is another measurement of the same pair. A repeated odometry edge may be
    refined slightly; with a very different rotation it is refused, because then the sender has begun anew and uses the
    same ids for other places. That holds of edges in a graph that was loaded, too.
    """

    def __init__(self, source: Source) -> None:
        self._source = source
        self._seen = Fingerprints(_MOST_REMEMBERED)
        self._stamp_ns: dict[Key, int] = {}
        self._odometry: dict[tuple[Key, Key], Quaternion] = {}
        # Number of the last loss between two keyframes; edges that were seen before it are new again.
        self._loss: dict[tuple[Key, Key], int] = {}
        self._num_losses = 0

    def forget(self) -> None:
        self._seen = Fingerprints(_MOST_REMEMBERED)
        self._stamp_ns.clear()
        self._odometry.clear()
        self._loss.clear()

    def note_given_up(self, source: KeyframeReference, target: KeyframeReference) -> None:
        _make_room(self._loss)
        self._num_losses += 1
        self._loss[ends_of(source, target)] = self._num_losses

    def _note_stamp(self, key: Key, stamp_ns: int, *, is_its_own: bool = True) -> None:
        """Remember when a keyframe was taken.

        Args:
            key: the keyframe.
            stamp_ns: 0 means that the sender does not say.
            is_its_own: whether the sender states it of this keyframe. Another one then means another keyframe, since
                the sender has begun anew; else the first counts.
        """
        if stamp_ns > 0:
            _make_room(self._stamp_ns)
            self._stamp_ns[key] = stamp_ns if is_its_own else self._stamp_ns.get(key, stamp_ns)

    def _edges(
        self, ends: tuple[Key, Key], rotation: Any, translation: Any, kind: int, precision: float
    ) -> Iterator[EdgeRecord]:
        """The edge from ``ends[0]`` to ``ends[1]``, unless it has been seen.

        Args:
            ends: source and target.
            rotation: ``geometry_msgs/Quaternion``, orientation of the target in the source frame.
            translation: ``geometry_msgs/Vector3`` or ``Point``, position of the target in the source frame, metres.
            kind: an ``EdgeKind`` value.
            precision: rad⁻², 0 unknown.
        """
        source_from_target = to_tuple(rotation)
        measurement = hash((*ends, kind, source_from_target, self._loss.get(ends, 0))) & MAX_ID
        if measurement in self._seen:
            return
        try:
            inside = target_from_source(source_from_target, self._source.body_from_sensor)
        except RejectedInputError as rejection:
            yield EdgeRecord(rejection.reason)
            return
        if kind == EdgeKind.ODOMETRY:
            _make_room(self._odometry)
            known = self._odometry.get(ends) or self._source.odometry_between(*ends) or inside
            self._odometry[ends] = known
            if contradict(known, inside):
                yield EdgeRecord(RejectReason.CONTRADICTORY_ODOMETRY)
                return
        self._seen.add(measurement)
        source, target = (KeyframeReference(*key, self._stamp_ns.get(key)) for key in ends)
        edge_id = edge_id_of(*ends, kind)
        # The sensor's position on the body is unknown, so its translation is taken for that of the body.
        position = quaternion.rotate(self._source.body_from_sensor, to_vector(translation))
        yield EdgeRecord(EdgeMeasurement(edge_id, source, target, inside, kind, precision, position))


def ends_of(source: KeyframeReference, target: KeyframeReference) -> tuple[Key, Key]:
    """The ends of an edge by keyframe id."""
    return _key(source), _key(target)


def _key(end: KeyframeReference) -> Key:
    assert end.keyframe_id is not None
    return end.robot, end.keyframe_id


def _make_room(memory: dict[Any, Any]) -> None:
    if len(memory) >= _MOST_REMEMBERED:
        memory.clear()


def edges_in_order(
    edges: Iterable[Any], kind_of: Mapping[int, int], no_edges: Collection[int]
) -> tuple[list[Any], int]:
    """Edges of the known types, odometry first, since it creates the keyframes that closures refer to.

    Args:
        edges: messages with a field ``type``.
        kind_of: the ``EdgeKind`` of every type that joins two keyframes.
        no_edges: types that do not join two keyframes.

    Returns:
        those edges, and the number of edges of unknown types.
    """
    edges = [edge for edge in edges if edge.type not in no_edges]
    known = sorted((edge for edge in edges if edge.type in kind_of), key=lambda edge: kind_of[edge.type])
    return known, len(edges) - len(known)
