"""Edges that are tied to the end of odometry until it goes on and comes to their stamps."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np

from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference

# As many as may wait by default; edges beyond it stay where they were tied first.
_MOST = 20_000


@dataclass(frozen=True, slots=True)
class Provisional:
    """An edge of the graph whose place is not final.

    Attributes:
        edge: as it was measured.
        waits_for: the end whose stamp odometry has not reached.
        row: of the graph's edges.
    """

    edge: EdgeMeasurement
    waits_for: KeyframeReference
    row: int


class ProvisionalEdges:
    """Those of a graph's edges whose place is not final, by the robot whose odometry they wait for."""

    def __init__(self, edges: Iterable[Provisional] = ()) -> None:
        self._by_robot: dict[str, list[Provisional]] = {}
        self._keep(edges)

    def __len__(self) -> int:
        return sum(map(len, self._by_robot.values()))

    def all(self) -> list[Provisional]:
        return [each for edges in self._by_robot.values() for each in edges]

    def add(self, provisional: Provisional) -> None:
        """Note an edge; where there are too many, its place becomes final."""
        if len(self) < _MOST:
            self._by_robot.setdefault(provisional.waits_for.robot, []).append(provisional)

    def pop_until(self, robot: str, stamp_ns: int) -> list[Provisional]:
        """Take out the edges that wait for a moment of a robot not later than the stamp."""
        edges = self._by_robot.pop(robot, None)
        if edges is None:
            return []
        if left := [each for each in edges if not _is_reached(each, stamp_ns)]:
            self._by_robot[robot] = left
        return [each for each in edges if _is_reached(each, stamp_ns)]

    def end_time_line(self, robot: str) -> None:
        """A robot's clock went back, and its stamps may mean other moments: edges with one stay where they are."""
        self._keep(each for each in self.all() if not each.edge.has_moment_of(robot))

    def renumber(self, renumbering: Renumbering) -> None:
        """Follow a compaction of the graph; the places of edges that were merged, if any, become final."""
        edge_of = renumbering.edge_of
        parts = np.bincount(edge_of[edge_of >= 0], minlength=1)
        moved = ((each, int(edge_of[each.row])) for each in self.all())
        self._keep(replace(each, row=row) for each, row in moved if row >= 0 and parts[row] == 1)

    def _keep(self, edges: Iterable[Provisional]) -> None:
        edges, self._by_robot = list(edges), {}
        for each in edges:
            self.add(each)


def _is_reached(provisional: Provisional, stamp_ns: int) -> bool:
    assert provisional.waits_for.stamp_ns is not None  # an end by id is in the graph, or the edge is not
    return provisional.waits_for.stamp_ns <= stamp_ns
