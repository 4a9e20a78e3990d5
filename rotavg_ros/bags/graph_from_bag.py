"""The view-graph in a bag: one that :mod:`rotavg_ros.bags.graph_to_bag` wrote, or odometry and stamped closures."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.bags.edge_frames import EdgeFrames
from rotavg_ros.bags.message_types import ODOMETRY, RELATIVE_ROTATION, RELATIVE_ROTATION_ARRAY
from rotavg_ros.bags.messages import Edge, Keyframe, read_edge, read_edges, read_odometry
from rotavg_ros.bags.odometry_of_graph import Pose, check_time, is_oriented, is_sound, taken_messages
from rotavg_ros.bags.reader import BagReader, BagReadError
from rotavg_ros.bags.topics import (
    EDGE_ARRAY_TOPIC,
    EDGE_TOPIC,
    GRAPH_NOTE,
    ODOM_TOPIC,
    TRUTH_TOPIC,
    static_transforms,
)
from rotavg_ros.datasets.files.graph_file import MAX_NODE_ID, GraphFile
from rotavg_ros.datasets.interpolation import poses_at
from rotavg_ros.datasets.planar import are_about_z, are_level
from rotavg_ros.inputs import EDGE_CONVERTERS
from rotavg_ros.inputs.records import Source
from rotavg_ros.inputs.rotavg import edge_from_message
from rotavg_ros.online.measurements import RejectedInputError, RejectReason, checked_edge
from rotavg_ros.view_graph import EdgeKind, ViewGraphError, where_possible

# Largest difference between a stamp that names a keyframe and the stamp of its odometry message.
_MAX_KEYFRAME_DISTANCE_NS = 50_000_000

_EDGES = {EDGE_TOPIC: RELATIVE_ROTATION, EDGE_ARRAY_TOPIC: RELATIVE_ROTATION_ARRAY}

_REPEATED = "edges that are sent again"
_NO_ROTATION, _NO_END = "edges whose rotation is none", "edges with an end that cannot be read"
# Why the estimator refuses an edge whatever the graph; those with both ends at one are counted later.
_WHY_LEFT_OUT = {
    RejectReason.NAN_ROTATION: _NO_ROTATION,
    RejectReason.ZERO_QUATERNION: _NO_ROTATION,
    RejectReason.UNNORMALIZED_QUATERNION: _NO_ROTATION,
    RejectReason.BAD_KIND: "edges of an unknown kind",
    RejectReason.BAD_PRECISION: "edges with a precision that is negative or not finite",
    RejectReason.BAD_REFERENCE: _NO_END,
    RejectReason.BAD_STAMP: _NO_END,
    RejectReason.WRONG_LENGTH: "edges with a translation that has not three numbers",
}
_ROBOT = Source("robot")  # only to read messages; a graph is of one robot, whatever its name

_CONJUGATE = np.array([-1.0, -1.0, -1.0, 1.0])


@dataclass
class _Content:
    """The content of a bag's known topics, in the order of recording."""

    edges: list[Edge] = field(default_factory=list)
    odometry: list[Pose] = field(default_factory=list)
    truth: list[Pose] = field(default_factory=list)
    note: dict[str, Any] = field(default_factory=dict)
    edge_topics: str = ""
    stamp_of: dict[int, int] = field(default_factory=dict)  # of keyframes by id: the first that is stated
    repeated: int = 0
    left_out: Counter[str] = field(default_factory=Counter)
    warnings: tuple[str, ...] = ()

    @property
    def by_id(self) -> bool:
        """Whether every edge names its ends by id."""
        return bool(self.edges) and all(end.id is not None for edge in self.edges for end in (edge.source, edge.target))

    @property
    def has_translations(self) -> bool:
        """Whether any edge has a translation."""
        return any(edge.translation is not None for edge in self.edges)


def read_graph_bag(path: str | Path) -> GraphFile:
    """Read the graph in a bag.

    Where the edges name their ends by id, they are the graph, in the order of the edges' own numbers. Where they name
    them by stamp, every odometry message that the estimator would take is a keyframe, consecutive ones are joined by
    odometry edges except where odometry begins anew, and an end belongs to the nearest of them within 0.05 s. Edges
    without such a message are skipped and counted, as are those that the estimator would refuse, and those that are the
    same as one before, since the sender has repeated itself. Edges between sensors are converted to the body's frame by
    the bag's static transforms. From a damaged bag, everything that can be read is used.

    Raises:
        BagReadError: an unreadable bag, one without edges, or one that needs odometry and has none, or odometry whose
            time goes back.
    """
    with BagReader(path, salvage=True) as bag:
        if bag.topics.get(EDGE_ARRAY_TOPIC) != RELATIVE_ROTATION_ARRAY:
            _require(bag, EDGE_TOPIC, RELATIVE_ROTATION)
        content = _read(bag)
        if content.left_out and not content.edges:
            raise BagReadError(f"{path}: {content.edge_topics}: no edge can be used; {_listed(content.left_out)}")
        if not content.by_id:
            _require(bag, ODOM_TOPIC, ODOMETRY)
            if not any(map(is_sound, content.odometry)):
                raise BagReadError(f"{path}: {ODOM_TOPIC} has no messages with a pose, so there are no keyframes")
            check_time(path, content.odometry)
        damage = bag.damage
    _check(path, content)
    try:
        graph_file = _from_ids(content) if content.by_id else _from_stamps(content)
    except ViewGraphError as error:
        raise BagReadError(f"{path}: {content.edge_topics}: {error}") from None
    if graph_file.graph.num_edges == 0:
        raise BagReadError(f"{path}: {content.edge_topics}: no edge joins two keyframes; there is no graph")
    return _with_truth(replace(graph_file, damage=damage, warnings=content.warnings), content)


def _require(bag: BagReader, topic: str, message_type: str) -> None:
    """Refuse a bag without that topic; where a replay has a use for others, with what to do."""
    try:
        bag.require(topic, message_type)
    except BagReadError as error:
        others = [name for name, kind in bag.topics.items() if kind in EDGE_CONVERTERS]
        if not others:
            raise
        replays = f"`rotavg replay` takes {', '.join(others)} and odometry of any name, and writes a graph.g2o"
        raise BagReadError(f"{error}; {replays}") from None


def _read(bag: BagReader) -> _Content:
    note = json.loads(bag.note(GRAPH_NOTE) or "{}")
    content, frames = _Content(note=note), EdgeFrames()
    transforms = static_transforms(bag.topics)
    known = {**_EDGES, ODOM_TOPIC: ODOMETRY, TRUTH_TOPIC: ODOMETRY}
    topics = [topic for topic, kind in known.items() if bag.topics.get(topic) == kind]
    content.edge_topics = ", ".join(topic for topic in topics if topic in _EDGES)
    for topic, _, message in bag.decoded([*topics, *transforms]):
        if topic == EDGE_TOPIC:
            content.edges += map(read_edge, _sound([message], content.left_out))
        elif topic == EDGE_ARRAY_TOPIC:
            message.edges = list(_sound(message.edges, content.left_out))
            content.edges += read_edges(message)
        elif topic == ODOM_TOPIC:
            content.odometry.append(read_odometry(message))
            frames.note_body(message.child_frame_id)
        elif topic == TRUTH_TOPIC:
            content.truth.append(read_odometry(message))
        else:
            frames.take(message)
    once: dict[Any, Edge] = {}
    for edge in content.edges:
        once.setdefault((edge.id, edge.source.key, edge.target.key, edge.source_from_target.tobytes()), edge)
        for end in (edge.source, edge.target):
            if end.id is not None and end.stamp_ns:
                content.stamp_of.setdefault(end.id, end.stamp_ns)
    content.repeated = len(content.edges) - len(once)
    content.edges = list(map(frames.edge_of_body, once.values()))  # the last transform may come after the edges
    content.warnings = frames.warnings
    return content


def _sound(messages: Iterable[Any], left_out: Counter[str]) -> Iterator[Any]:
    """The messages of edges that the estimator would not refuse whatever the graph; the others are counted."""
    for message in messages:
        try:
            checked_edge(edge_from_message(message, _ROBOT))
        except RejectedInputError as rejection:
            if rejection.reason in _WHY_LEFT_OUT:
                left_out[_WHY_LEFT_OUT[rejection.reason]] += 1
                continue
        yield message


def _check(path: str | Path, content: _Content) -> None:
    """Refuse content that a graph cannot hold."""
    ends = [end for edge in content.edges for end in (edge.source, edge.target)]
    robots = sorted({end.robot for end in ends})
    if len(robots) > 1:
        names = ", ".join(repr(robot) for robot in robots)
        told = "a graph has room for one; `rotavg replay` reads the bag, and writes a graph.g2o of all"
        raise BagReadError(f"{path}: edges of several robots ({names}), and {told}")
    if content.by_id and (largest := max(end.id or 0 for end in ends)) > MAX_NODE_ID:
        raise BagReadError(f"{path}: keyframe id {largest} is too large; the largest possible is {MAX_NODE_ID}")


def _from_ids(content: _Content) -> GraphFile:
    proper = [position for position, edge in enumerate(content.edges) if edge.source.id != edge.target.id]
    order = sorted(proper, key=lambda position: content.edges[position].id)
    edges = [content.edges[position] for position in order]
    ends = np.array([(edge.source.id, edge.target.id) for edge in edges], dtype=np.int64)
    ends = ends.reshape(-1, 2)
    source_from_target = np.array([edge.source_from_target for edge in edges]).reshape(-1, 4)
    translations = _possible(_translations(edges)) if content.has_translations else None
    note = content.note
    graph_file = GraphFile.from_ids(
        ends[:, 0],
        ends[:, 1],
        source_from_target * _CONJUGATE,
        lone_ids=np.array(note.get("lone_ids", []), dtype=np.int64),
        kind=np.array([edge.kind for edge in edges]),
        precision=np.array([edge.precision for edge in edges]),
        planar=bool(note.get("planar", are_about_z(source_from_target) and are_level(translations))),
        edge_translation=translations,
        skipped=_counted(
            {"self-edges": len(content.edges) - len(proper), _REPEATED: content.repeated, **content.left_out}
        ),
    )
    stamp_of = content.stamp_of | dict(zip(note.get("lone_ids", []), note.get("lone_stamps_ns", []), strict=False))
    stamps_ns = np.array([stamp_of.get(node_id, 0) for node_id in graph_file.node_ids.tolist()], dtype=np.int64)
    return replace(graph_file, stamps_ns=stamps_ns) if stamps_ns.any() or "stamps" in note else graph_file


def _from_stamps(content: _Content) -> GraphFile:
    taken, chain, skipped = taken_messages(content.odometry)
    stamps_ns = np.array([stamp for stamp, _, _ in taken], dtype=np.int64)
    position = np.array([place for _, place, _ in taken])
    world_from_body = Rotation.from_quat([rotation for _, _, rotation in taken])
    ends = np.array([[_nearest(stamps_ns, end) for end in (edge.source, edge.target)] for edge in content.edges])
    ends = ends.reshape(-1, 2)
    usable = (ends >= 0).all(axis=1) & (ends[:, 0] != ends[:, 1])
    closures = [edge for edge, keep in zip(content.edges, usable, strict=True) if keep]

    before = np.flatnonzero(np.diff(chain) == 0)
    num_steps = len(before)
    previous_from_next = (world_from_body[before].inv() * world_from_body[before + 1]).as_quat().reshape(-1, 4)
    steps = world_from_body[before].inv().apply(position[before + 1] - position[before]).reshape(-1, 3)
    measured = np.array([edge.source_from_target for edge in closures]).reshape(-1, 4)
    source_from_target = np.concatenate((previous_from_next, measured))
    source = np.concatenate((before, ends[usable, 0]))
    target = np.concatenate((before + 1, ends[usable, 1]))
    order = np.argsort(np.maximum(source, target), kind="stable")
    translations = _possible(np.concatenate((steps, _translations(closures))))
    skipped |= {
        "edges without odometry at their stamps, or with both ends at one": int((~usable).sum()),
        _REPEATED: content.repeated,
        **content.left_out,
    }
    graph_file = GraphFile.from_ids(
        source[order],
        target[order],
        (source_from_target * _CONJUGATE)[order],
        lone_ids=np.arange(len(stamps_ns)),
        kind=np.array([EdgeKind.ODOMETRY] * num_steps + [edge.kind for edge in closures])[order],
        precision=np.array([np.nan] * num_steps + [edge.precision for edge in closures])[order],
        planar=are_about_z(source_from_target) and are_level(translations),
        edge_translation=translations[order],
        skipped=_counted(skipped),
    )
    content.warnings += _told_of_parts(int(chain[-1]))
    return replace(graph_file, stamps_ns=stamps_ns)


def _told_of_parts(num_anew: int) -> tuple[str, ...]:
    """A line where odometry has begun anew."""
    if not num_anew:
        return ()
    return (f"odometry begins anew {num_anew} ×; only closures join what was before to what comes after",)


def _counted(skipped: dict[str, int]) -> dict[str, int]:
    return {what: count for what, count in skipped.items() if count}


def _listed(counts: Counter[str]) -> str:
    return ", ".join(f"{count} × {what}" for what, count in counts.items())


def _translations(edges: Sequence[Edge]) -> NDArray[np.float64]:
    """``(n, 3)`` metres; NaN where unknown."""
    rows = [np.full(3, np.nan) if edge.translation is None else edge.translation for edge in edges]
    return np.array(rows).reshape(-1, 3)


def _possible(translation: NDArray[np.float64]) -> NDArray[np.float64]:
    """``(n, 3)`` metres; NaN where it is none, as files state it."""
    return np.asarray(where_possible(torch.from_numpy(translation)))


def _nearest(stamps_ns: NDArray[np.int64], end: Keyframe) -> int:
    """Index of the stamp nearest to an end's, or -1 if it is too far away."""
    right = int(np.searchsorted(stamps_ns, end.stamp_ns))
    candidates = [index for index in (right - 1, right) if 0 <= index < len(stamps_ns)]
    best = min(candidates, key=lambda index: abs(int(stamps_ns[index]) - end.stamp_ns))
    return best if abs(int(stamps_ns[best]) - end.stamp_ns) <= _MAX_KEYFRAME_DISTANCE_NS else -1


def _with_truth(graph_file: GraphFile, content: _Content) -> GraphFile:
    """Add ground truth to the nodes; drop stamps that were only made up for the bag.

    A node has the truth of its own stamp, or, unless the bag was made of a graph whose truth has gaps, that between the
    stamps around it.
    """
    if graph_file.stamps_ns is None:
        return graph_file
    nodes_at: dict[int, list[int]] = {}
    for node, stamp in enumerate(graph_file.stamps_ns.tolist()):
        nodes_at.setdefault(stamp, []).append(node)
    num_nodes = len(graph_file.node_ids)
    position, orientation = np.full((num_nodes, 3), np.nan), np.full((num_nodes, 4), np.nan)
    for stamp, true_position, true_orientation in content.truth:
        if nodes := nodes_at.get(stamp):
            node = nodes.pop(0) if len(nodes) > 1 else nodes[0]
            position[node] = true_position
            if is_oriented((stamp, true_position, true_orientation)):
                orientation[node] = np.array(true_orientation) * _CONJUGATE
    if content.truth:
        if not content.note:
            _fill(graph_file.stamps_ns, [pose for pose in content.truth if is_oriented(pose)], position, orientation)
        if np.isfinite(orientation).any():
            graph_file = replace(graph_file, body_from_world_gt=orientation)
        if content.note.get("position_gt", True):
            graph_file = replace(graph_file, position_gt=position)
    if not content.note.get("stamps", True):
        graph_file = replace(graph_file, stamps_ns=None)
    return graph_file


def _fill(
    stamps_ns: NDArray[np.int64],
    truth: list[Pose],
    position: NDArray[np.float64],
    orientation: NDArray[np.float64],
) -> None:
    """Write into the rows of both that are unknown what lies between true poses."""
    unknown = np.isnan(orientation).any(axis=1) & np.isnan(position).any(axis=1)
    world_from_body, places = poses_at(
        stamps_ns[unknown],
        np.array([stamp for stamp, _, _ in truth], dtype=np.int64),
        np.array([rotation for _, _, rotation in truth]).reshape(-1, 4),
        np.array([place for _, place, _ in truth]).reshape(-1, 3),
    )
    assert places is not None
    position[unknown], orientation[unknown] = places, world_from_body * _CONJUGATE
