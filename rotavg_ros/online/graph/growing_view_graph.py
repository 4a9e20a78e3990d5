"""A view-graph that grows by appending; compaction removes some keyframes and edges, and the others move up."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros.odometry_route import ROUTE_COLUMNS
from rotavg_ros.online.compaction.chain import Columns
from rotavg_ros.online.compaction.marginalization import marginalize
from rotavg_ros.online.compaction.marginalized_keyframes import Forgotten, MarginalizedIndex, MarginalizedKeyframes
from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.compaction.thinning import Verdict, thin
from rotavg_ros.online.graph.keyframe_index import KeyframeIndex
from rotavg_ros.online.graph.snapshot import GraphEdge, GraphSnapshot
from rotavg_ros.online.growing_array import GrowingArray
from rotavg_ros.online.measurements import UNKNOWN_STAMP_NS
from rotavg_ros.online.quaternion import Quaternion, Vector
from rotavg_ros.view_graph import EdgeKind, ViewGraph

_KEYFRAME_COLUMNS = {"robot": np.int64, "keyframe_id": np.uint64, "stamp_ns": np.int64, "time_line": np.int64}
_EDGE_COLUMNS = {
    "edge_id": (np.uint64, None),
    "source": (np.int64, None),
    "target": (np.int64, None),
    "target_from_source": (np.float64, 4),
    "kind": (np.int64, None),
    "precision": (np.float64, None),
    "label": (np.int64, None),
    "translation": (np.float64, 3),
    "steps": (np.float64, None),
    "route": (np.int64, None),
}
_SOLVED_COLUMNS = ("source", "target", "target_from_source", "kind", "precision", "label", "steps")
# What changes of an edge that is tied to other keyframes.
_TIED_COLUMNS = ("source", "target", "target_from_source", "translation")
# Share of all keyframes that are protected from compaction as the robots' latest.
_LATEST_SHARE = 0.1


class GrowingViewGraph:
    """Keyframes keyed by (robot, id) and the edges between them.

    Not thread-safe.

    Attributes:
        revision: counts changes: equal revisions mean equal graphs.
        tied_anew_at, compacted_at: revisions since which edges, once there, have been tied to the same keyframes, and
            nodes and edges have had the same indices.
        robots: names, in the order in which they came.
        marginalized: keyframes that are no longer nodes.
    """

    def __init__(self) -> None:
        self.revision = self.tied_anew_at = self.compacted_at = 0
        self.robots: list[str] = []
        self.marginalized = MarginalizedIndex.of(MarginalizedKeyframes.none(), Forgotten())
        self._robot_index: dict[str, int] = {}
        self._index: list[KeyframeIndex] = []  # by robot
        self._keyframe = {name: GrowingArray(dtype) for name, dtype in _KEYFRAME_COLUMNS.items()}
        self._edge = {name: GrowingArray(*column) for name, column in _EDGE_COLUMNS.items()}
        self._routes = np.empty((0, ROUTE_COLUMNS))

    @property
    def num_keyframes(self) -> int:
        return len(self._keyframe["robot"])

    @property
    def num_edges(self) -> int:
        return len(self._edge["edge_id"])

    def add_keyframe(self, robot: str, keyframe_id: int, stamp_ns: int = UNKNOWN_STAMP_NS, time_line: int = 0) -> int:
        """Append a keyframe, or find it and add a missing moment (a stamp on a time line); returns its node."""
        robot_index = self._index_of_robot(robot)
        index = self._index[robot_index]
        node = index.node(keyframe_id)
        if node is None:
            node = self.num_keyframes
            index.add(keyframe_id, node)
            self._keyframe["robot"].append(robot_index)
            self._keyframe["keyframe_id"].append(keyframe_id)
            self._keyframe["stamp_ns"].append(UNKNOWN_STAMP_NS)
            self._keyframe["time_line"].append(time_line)
            self.revision += 1
        stamps = self._keyframe["stamp_ns"].view
        if stamp_ns != UNKNOWN_STAMP_NS and stamps[node] == UNKNOWN_STAMP_NS:
            stamps[node] = stamp_ns
            self._keyframe["time_line"].view[node] = time_line
            index.add_moment(time_line, stamp_ns, node)
            self.revision += 1
        return node

    def add_edge(self, edge: GraphEdge) -> None:
        """Append an edge between two nodes."""
        for name, column in self._edge.items():
            column.append(getattr(edge, name))
        self.revision += 1

    def tie_anew(self, edges: Mapping[int, GraphEdge]) -> None:
        """Tie edges, by row, to the keyframes of these ones, with their rotations and translations."""
        rows = [row for row, edge in edges.items() if not self._is_tied_as(row, edge)]
        if not rows:
            return
        for name in _TIED_COLUMNS:
            column = self._edge[name]
            values = column.view.copy()  # snapshots keep what they have
            values[rows] = [getattr(edges[row], name) for row in rows]
            column.replace(values)
        self.revision += 1
        self.tied_anew_at = self.revision

    def _is_tied_as(self, row: int, edge: GraphEdge) -> bool:
        now = ((self._edge[name].view[row], getattr(edge, name)) for name in _TIED_COLUMNS)
        return all(np.array_equal(one, other, equal_nan=True) for one, other in now)

    def label_edges(self, source_robot: str, edge_id: int, label: int) -> int:
        """Label every edge with the sender's id and source robot; returns how many there are."""
        robot_of_source = self._keyframe["robot"].view[self._edge["source"].view]
        robot = self._robot_index.get(source_robot, -1)
        chosen = (self._edge["edge_id"].view == np.uint64(edge_id)) & (robot_of_source == robot)
        labels = self._edge["label"].view
        if (labels[chosen] != label).any():
            labels[chosen] = label
            self.revision += 1
        return int(chosen.sum())

    def node(self, robot: str, keyframe_id: int) -> int | None:
        index = self._index_of(robot)
        return None if index is None else index.node(keyframe_id)

    def odometry_between(self, source: tuple[str, int], target: tuple[str, int]) -> Quaternion | None:
        """Measured target_from_source of the first odometry edge from one keyframe, (robot, id), to another, if any."""
        ends = self.node(*source), self.node(*target)
        if None in ends:
            return None
        # One pass over all edges: after a restart a front end asks this of each edge of the graph that it repeats.
        (rows,) = np.nonzero(self._edge["target"].view == ends[1])
        is_wanted = (self._edge["source"].view[rows] == ends[0]) & (self._edge["kind"].view[rows] == EdgeKind.ODOMETRY)
        if not is_wanted.any():
            return None
        x, y, z, w = self._edge["target_from_source"].view[rows[is_wanted.argmax()]].tolist()
        return (x, y, z, w)

    def robot_of(self, node: int) -> str:
        return self.robots[int(self._keyframe["robot"].view[node])]

    def moment_of(self, node: int) -> tuple[int, int]:
        """Stamp in nanoseconds, -1 where unknown, and number of the time line."""
        return int(self._keyframe["stamp_ns"].view[node]), int(self._keyframe["time_line"].view[node])

    def keyframe_at_or_before(self, robot: str, stamp_ns: int, time_line: int) -> int | None:
        """The newest node of the robot's time line that is not younger than the stamp."""
        index = self._index_of(robot)
        return None if index is None else index.at_or_before(time_line, stamp_ns)

    def first_keyframe(self, robot: str, time_line: int) -> int | None:
        """The node of the robot's time line with the smallest stamp."""
        index = self._index_of(robot)
        return None if index is None else index.first(time_line)

    def nodes_newest_first(self, robot: str, time_line: int, first_ns: int, last_ns: int) -> Iterator[int]:
        """The nodes of the robot's time line with stamps from the first to the last, the latest moment first."""
        index = self._index_of(robot)
        return iter(()) if index is None else index.newest_first(time_line, first_ns, last_ns)

    def moments(self, robot: str) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Stamps and time lines of the robot's nodes with a stamp, in order of their moments."""
        return (KeyframeIndex() if (index := self._index_of(robot)) is None else index).moments

    def marginalized_keyframe(
        self, robot: str, keyframe_id: int | None, stamp_ns: int | None, time_line: int
    ) -> tuple[int, Quaternion, Vector] | None:
        """A marginalised keyframe by id, or by its exact moment.

        Returns:
            the node of the nearer end of the odometry edge that it lies on; its orientation and its position (metres)
            in that keyframe's frame. None if there is no such keyframe.
        """
        row = self._marginalized_row(robot, keyframe_id, stamp_ns, time_line)
        if row is None:
            return None
        edge = int(self.marginalized.keyframes.edge[row])
        columns = (self._edge[name].view[edge] for name in ("target_from_source", "translation", "steps"))
        at_source, rotation, position = self.marginalized.nearest_end(row, *columns)
        x, y, z = position.tolist()
        qx, qy, qz, qw = rotation.tolist()
        return int(self._edge["source" if at_source else "target"].view[edge]), (qx, qy, qz, qw), (x, y, z)

    def lies_on_an_edge(self, robot: str, keyframe_id: int) -> bool:
        """Whether it is a marginalised keyframe whose pose is still known."""
        return self._marginalized_row(robot, keyframe_id) is not None

    def free_id(self, robot: str, keyframe_id: int, moment: tuple[int, int]) -> int:
        """The first id from this one on that is no keyframe's of another moment (a stamp and its time line).

        A front end may have used an id before odometry did, and stamps that serve as ids come again on another time
        line.
        """
        while self._is_anothers(robot, keyframe_id, moment):
            keyframe_id += 1
        return keyframe_id

    def _is_anothers(self, robot: str, keyframe_id: int, moment: tuple[int, int]) -> bool:
        node = self.node(robot, keyframe_id)
        if node is None:
            return self.lies_on_an_edge(robot, keyframe_id)
        stamp_ns, _ = known = self.moment_of(node)
        return stamp_ns != UNKNOWN_STAMP_NS and known != moment

    def was_marginalized(self, robot: str, keyframe_id: int) -> bool:
        """Whether there was such a keyframe, known or forgotten."""
        if self.lies_on_an_edge(robot, keyframe_id):
            return True
        return self.marginalized.is_forgotten(self._robot_index.get(robot, -1), keyframe_id)

    def was_moment_marginalized(self, robot: str, stamp_ns: int, time_line: int) -> bool:
        """Whether there was a keyframe of this moment, known or forgotten."""
        if self._marginalized_row(robot, None, stamp_ns, time_line) is not None:
            return True
        return self.marginalized.is_moment_forgotten(self._robot_index.get(robot, -1), time_line, stamp_ns)

    def compact(
        self,
        surplus_keyframes: int,
        surplus_edges: int,
        verdict: NDArray[np.int8],
        max_marginalized: int,
        needed: Sequence[int],
    ) -> Renumbering | None:
        """Remove keyframes and edges that :func:`thin` chooses; None if nothing can be spared.

        Args:
            surplus_keyframes, surplus_edges: how many to remove.
            verdict: :class:`Verdict` on the first M' ≤ M edges.
            max_marginalized: number of marginalised keyframes whose poses are remembered.
            needed: nodes that stay, besides the robots' latest.
        """
        keyframes: Columns = {name: column.view for name, column in self._keyframe.items()}
        edges: Columns = {name: column.view for name, column in self._edge.items()}
        verdicts = np.full(self.num_edges, Verdict.BELIEVED, dtype=np.int8)
        verdicts[: len(verdict)] = verdict
        protected = self._latest()
        protected[list(needed)] = True
        riders = self.marginalized.keyframes
        carries = np.zeros(self.num_edges, dtype=bool)
        carries[riders.edge] = True
        thinning = thin(edges, verdicts, protected, carries, surplus_keyframes, surplus_edges)
        if not thinning.nodes.any() and not thinning.edges.any():
            return None
        num_closures = int((thinning.edges & (edges["kind"] == EdgeKind.LOOP_CLOSURE)).sum())
        stays = np.flatnonzero(~thinning.edges)
        place = np.cumsum(~thinning.edges) - 1
        riders = MarginalizedKeyframes(**(riders.arrays() | {"edge": place[riders.edge]}))
        left = {name: values[stays] for name, values in edges.items()}
        contraction = marginalize(keyframes, left, self._routes, thinning.nodes, riders)
        self._routes = contraction.routes
        for name, keyframe_column in self._keyframe.items():
            keyframe_column.replace(keyframes[name][contraction.kept])
        for name, edge_column in self._edge.items():
            edge_column.replace(contraction.edges[name])
        self._index_anew()
        known = MarginalizedIndex.of(contraction.marginalized, self.marginalized.forgotten)
        self.marginalized = known.limited_to(max_marginalized)
        self.revision += 1
        self.compacted_at = self.revision
        edge_of = np.full(len(place), -1)
        edge_of[stays] = contraction.edge_of
        return Renumbering(contraction.kept, edge_of, stays[contraction.last], num_closures)

    def snapshot(self) -> GraphSnapshot:
        """The present graph. Only labels and moments are copied, since nothing else can change later."""
        columns = {name: self._edge[name].view for name in _SOLVED_COLUMNS}
        columns["label"] = columns["label"].copy()
        columns["translation"] = self._edge["translation"].view
        if len(self._routes):
            columns["route"], columns["routes"] = self._edge["route"].view, self._routes
        return GraphSnapshot(
            graph=ViewGraph(self.num_keyframes, **{name: torch.from_numpy(values) for name, values in columns.items()}),
            robots=tuple(self.robots),
            keyframe_robot=self._keyframe["robot"].view,
            keyframe_id=self._keyframe["keyframe_id"].view,
            stamp_ns=self._keyframe["stamp_ns"].view.copy(),
            time_line=self._keyframe["time_line"].view.copy(),
            edge_id=self._edge["edge_id"].view,
            translation=self._edge["translation"].view,
            marginalized=self.marginalized,
            revision=self.revision,
        )

    @classmethod
    def from_snapshot(cls, snapshot: GraphSnapshot) -> GrowingViewGraph:
        """A growing graph with the same content and the same indices.

        Raises:
            ValueError: columns of different lengths, an index out of range, or a keyframe that occurs twice.
        """
        growing = cls()
        for robot in snapshot.robots:
            growing._index_of_robot(robot)
        for name, values in (
            ("robot", snapshot.keyframe_robot),
            ("keyframe_id", snapshot.keyframe_id),
            ("stamp_ns", snapshot.stamp_ns),
            ("time_line", snapshot.time_line),
        ):
            growing._keyframe[name].extend(values)
        growing._edge["edge_id"].extend(snapshot.edge_id)
        growing._edge["translation"].extend(snapshot.translation)
        for name in _SOLVED_COLUMNS:
            growing._edge[name].extend(getattr(snapshot.graph, name).numpy())
        graph = snapshot.graph
        unknown = torch.full((graph.num_edges,), -1)
        growing._edge["route"].extend((unknown if graph.route is None else graph.route).numpy())
        if graph.routes is not None:
            growing._routes = graph.routes.numpy()
        marginalized = snapshot.marginalized.keyframes
        _check_rows(growing._keyframe, len(snapshot.robots), "robot")
        _check_rows(growing._edge, growing.num_keyframes, "source", "target")
        if not ((marginalized.edge >= 0) & (marginalized.edge < growing.num_edges)).all():
            raise ValueError("a keyframe on an edge that is not there")
        route = growing._edge["route"].view
        if growing._routes.shape[1:] != (ROUTE_COLUMNS,) or not ((route >= -1) & (route < len(growing._routes))).all():
            raise ValueError("a route that is not there")
        if np.isinf(growing._routes).any():
            raise ValueError("a route without end")
        growing._index_anew()
        growing.marginalized = snapshot.marginalized
        growing.revision = snapshot.revision
        return growing

    def _latest(self) -> NDArray[np.bool_]:
        """The latest keyframes of every robot, two at least, ``(N,)``."""
        robot = self._keyframe["robot"].view
        count = max(2, int(_LATEST_SHARE * len(robot) / max(len(self.robots), 1)))
        order = np.argsort(robot, kind="stable")
        last = np.searchsorted(robot[order], robot, "right") - 1
        place = np.empty(len(robot), dtype=np.int64)
        place[order] = np.arange(len(robot))
        return np.asarray(last - place < count)

    def _index_anew(self) -> None:
        columns = {name: column.view for name, column in self._keyframe.items()}
        for robot in range(len(self.robots)):
            nodes = np.flatnonzero(columns["robot"] == robot)
            of_robot = (columns[name][nodes] for name in ("keyframe_id", "time_line", "stamp_ns"))
            self._index[robot] = KeyframeIndex.of(nodes, *of_robot)

    def _marginalized_row(
        self, robot: str, keyframe_id: int | None, stamp_ns: int | None = None, time_line: int = 0
    ) -> int | None:
        robot_index = self._robot_index.get(robot)
        if robot_index is None or len(self.marginalized.keyframes) == 0:
            return None
        if keyframe_id is not None:
            return self.marginalized.by_id(robot_index, keyframe_id)
        return None if stamp_ns is None else self.marginalized.by_moment(robot_index, time_line, stamp_ns)

    def _index_of(self, robot: str) -> KeyframeIndex | None:
        robot_index = self._robot_index.get(robot)
        return None if robot_index is None else self._index[robot_index]

    def _index_of_robot(self, robot: str) -> int:
        index = self._robot_index.setdefault(robot, len(self.robots))
        if index == len(self.robots):
            self.robots.append(robot)
            self._index.append(KeyframeIndex())
        return index


def _check_rows(columns: Mapping[str, GrowingArray], limit: int, *indices: str) -> None:
    """Equal lengths, and columns of indices below a limit."""
    if len({len(column) for column in columns.values()}) > 1:
        raise ValueError("columns of different lengths")
    for name in indices:
        view = columns[name].view
        if ((view < 0) | (view >= limit)).any():
            raise ValueError(f"{name} is out of range")
