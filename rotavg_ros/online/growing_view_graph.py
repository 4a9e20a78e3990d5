"""A view-graph that only grows: keyframes and edges are appended, indices never change."""

from __future__ import annotations

from bisect import bisect_right, insort
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from numpy.typing import DTypeLike, NDArray

from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS
from rotavg_ros.online.quaternion import UNKNOWN_VECTOR, Quaternion, Vector
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


class GrowingArray:
    """Append-only numpy array; its storage doubles, so an append is O(1) on average.

    A :attr:`view` keeps its length and its rows however much the array grows afterwards.
    """

    def __init__(self, dtype: DTypeLike, width: int | None = None) -> None:
        self._data = np.empty((64,) if width is None else (64, width), dtype=dtype)
        self._size = 0

    def __len__(self) -> int:
        return self._size

    @property
    def view(self) -> NDArray[Any]:
        """The rows so far, not copied."""
        return self._data[: self._size]

    def append(self, row: float | Sequence[float]) -> None:
        self._reserve(self._size + 1)
        self._data[self._size] = row
        self._size += 1

    def extend(self, rows: NDArray[Any]) -> None:
        self._reserve(self._size + len(rows))
        self._data[self._size : self._size + len(rows)] = rows
        self._size += len(rows)

    def _reserve(self, size: int) -> None:
        capacity = len(self._data)
        if size <= capacity:
            return
        grown = np.empty((max(size, 2 * capacity), *self._data.shape[1:]), dtype=self._data.dtype)
        grown[: self._size] = self.view
        self._data = grown  # old views keep the old storage


@dataclass(frozen=True)
class GraphSnapshot:
    """The graph at one moment, sharing memory with the growing one (N keyframes, M edges).

    Attributes:
        graph: what the solver gets.
        robots: names.
        keyframe_robot: ``(N,)`` int32 index into ``robots``.
        keyframe_id: ``(N,)`` uint64.
        stamp_ns: ``(N,)`` int64, -1 where unknown.
        edge_id: ``(M,)`` uint64, the senders' ids.
        translation: ``(M, 3)`` position of the edge's target in its source's frame, metres; NaN unknown.
        revision: of the growing graph.
    """

    graph: ViewGraph
    robots: tuple[str, ...]
    keyframe_robot: NDArray[np.int32]
    keyframe_id: NDArray[np.uint64]
    stamp_ns: NDArray[np.int64]
    edge_id: NDArray[np.uint64]
    translation: NDArray[np.float64]
    revision: int


class GrowingViewGraph:
    """Keyframes keyed by (robot, id) and the edges between them.

    ``revision`` counts changes: equal revisions mean equal graphs. Not thread-safe.
    """

    def __init__(self) -> None:
        self.revision = 0
        self.robots: list[str] = []
        self._robot_index: dict[str, int] = {}
        self._node_of_key: dict[tuple[str, int], int] = {}
        # Per robot: stamps in ascending order and the nodes in the same order.
        self._by_stamp: dict[str, list[tuple[int, int]]] = {}
        self._keyframe_robot = GrowingArray(np.int32)
        self._keyframe_id = GrowingArray(np.uint64)
        self._stamp_ns = GrowingArray(np.int64)
        self._edge_id = GrowingArray(np.uint64)
        self._source = GrowingArray(np.int64)
        self._target = GrowingArray(np.int64)
        self._target_from_source = GrowingArray(np.float64, width=4)
        self._kind = GrowingArray(np.int64)
        self._precision = GrowingArray(np.float64)
        self._label = GrowingArray(np.int64)
        self._translation = GrowingArray(np.float64, width=3)

    @property
    def num_keyframes(self) -> int:
        return len(self._keyframe_id)

    @property
    def num_edges(self) -> int:
        return len(self._edge_id)

    def add_keyframe(self, robot: str, keyframe_id: int, stamp_ns: int = UNKNOWN_STAMP_NS) -> int:
        """Append a keyframe, or find it and complete its stamp; returns its node."""
        node = self._node_of_key.get((robot, keyframe_id))
        if node is None:
            node = self.num_keyframes
            self._node_of_key[robot, keyframe_id] = node
            self._keyframe_robot.append(self._index_of_robot(robot))
            self._keyframe_id.append(keyframe_id)
            self._stamp_ns.append(UNKNOWN_STAMP_NS)
            self.revision += 1
        if stamp_ns != UNKNOWN_STAMP_NS and self._stamp_ns.view[node] == UNKNOWN_STAMP_NS:
            self._stamp_ns.view[node] = stamp_ns
            insort(self._by_stamp.setdefault(robot, []), (stamp_ns, node))
        return node

    def add_edge(
        self,
        edge_id: int,
        source: int,
        target: int,
        target_from_source: Quaternion,
        kind: int,
        precision: float,
        label: int = EdgeLabel.AUTOMATIC,
        translation: Vector = UNKNOWN_VECTOR,
    ) -> None:
        """Append an edge between two nodes; the rotation must be of unit length. Precision in rad⁻², NaN unknown."""
        self._edge_id.append(edge_id)
        self._source.append(source)
        self._target.append(target)
        self._target_from_source.append(target_from_source)
        self._kind.append(kind)
        self._precision.append(precision)
        self._label.append(label)
        self._translation.append(translation)
        self.revision += 1

    def label_edges(self, source_robot: str, edge_id: int, label: int) -> int:
        """Label every edge with the sender's id and source robot; returns how many there are."""
        robot_of_source = self._keyframe_robot.view[self._source.view]
        robot = self._robot_index.get(source_robot, -1)
        chosen = (self._edge_id.view == np.uint64(edge_id)) & (robot_of_source == robot)
        if (self._label.view[chosen] != label).any():
            self._label.view[chosen] = label
            self.revision += 1
        return int(chosen.sum())

    def node(self, robot: str, keyframe_id: int) -> int | None:
        return self._node_of_key.get((robot, keyframe_id))

    def robot_of(self, node: int) -> str:
        return self.robots[int(self._keyframe_robot.view[node])]

    def stamp_of(self, node: int) -> int:
        """Nanoseconds, or -1."""
        return int(self._stamp_ns.view[node])

    def keyframe_at_or_before(self, robot: str, stamp_ns: int) -> int | None:
        """The robot's newest node that is not younger than the stamp."""
        stamps = self._by_stamp.get(robot, [])
        position = bisect_right(stamps, (stamp_ns, self.num_keyframes))
        return stamps[position - 1][1] if position else None

    def first_keyframe(self, robot: str) -> int | None:
        """The robot's node with the smallest stamp."""
        stamps = self._by_stamp.get(robot)
        return stamps[0][1] if stamps else None

    def nodes_newest_first(self, robot: str) -> Iterator[int]:
        """The robot's nodes with a stamp, in descending order of it."""
        return (node for _, node in reversed(self._by_stamp.get(robot, [])))

    def snapshot(self) -> GraphSnapshot:
        """The graph now. Only the labels, which alone can change later, are copied."""
        graph = ViewGraph(
            num_nodes=self.num_keyframes,
            source=torch.from_numpy(self._source.view),
            target=torch.from_numpy(self._target.view),
            target_from_source=torch.from_numpy(self._target_from_source.view),
            kind=torch.from_numpy(self._kind.view),
            precision=torch.from_numpy(self._precision.view),
            label=torch.from_numpy(self._label.view.copy()),
        )
        return GraphSnapshot(
            graph=graph,
            robots=tuple(self.robots),
            keyframe_robot=self._keyframe_robot.view,
            keyframe_id=self._keyframe_id.view,
            stamp_ns=self._stamp_ns.view.copy(),
            edge_id=self._edge_id.view,
            translation=self._translation.view,
            revision=self.revision,
        )

    @classmethod
    def from_snapshot(cls, snapshot: GraphSnapshot) -> GrowingViewGraph:
        """A growing graph with the same content and the same indices."""
        growing = cls()
        keys = zip(
            snapshot.keyframe_robot.tolist(), snapshot.keyframe_id.tolist(), snapshot.stamp_ns.tolist(), strict=True
        )
        for robot in snapshot.robots:
            growing._index_of_robot(robot)
        for robot_index, keyframe_id, stamp_ns in keys:
            growing.add_keyframe(snapshot.robots[robot_index], keyframe_id, stamp_ns)
        growing._edge_id.extend(snapshot.edge_id)
        growing._translation.extend(snapshot.translation)
        for column in ("source", "target", "target_from_source", "kind", "precision", "label"):
            getattr(growing, f"_{column}").extend(getattr(snapshot.graph, column).numpy())
        growing.revision = snapshot.revision
        return growing

    def _index_of_robot(self, robot: str) -> int:
        index = self._robot_index.setdefault(robot, len(self.robots))
        if index == len(self.robots):
            self.robots.append(robot)
        return index
