"""Components that have become one since the last answer."""

from __future__ import annotations

from bisect import bisect_left
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.answer.answer import Answer


@dataclass(frozen=True)
class Join:
    """Components whose relative orientation was arbitrary until now.

    Attributes:
        robots: names of the robots with keyframes in them, sorted; a single one: pieces of its track were joined.
        num_components: how many became one.
    """

    robots: tuple[str, ...]
    num_components: int

    def __str__(self) -> str:
        if len(self.robots) == 1:
            return f"{self.num_components} pieces of {self.robots[0]}'s track are joined"
        return f"{', '.join(self.robots[:-1])} and {self.robots[-1]} are joined"


def joins(before: Answer, now: Answer) -> list[Join]:
    """What has been joined between an answer and a later one about the same graph, grown or compacted since."""
    old = before.component
    first_nodes = np.unique(old, return_index=True)[1]
    component_now = now.component[_places(before, first_nodes, now)]
    found = []
    for component in np.flatnonzero(np.bincount(component_now) > 1):
        parts = np.flatnonzero(component_now == component)
        robots = {before.robots[robot] for robot in np.unique(before.keyframe_robot[np.isin(old, parts)])}
        found.append(Join(tuple(sorted(robots)), len(parts)))
    return found


def _places(before: Answer, nodes: NDArray[np.int64], now: Answer) -> NDArray[np.int64]:
    """Where nodes of an earlier answer are in a later one; all of them must still be there."""
    if len(now.keyframe_id) >= len(before.keyframe_id):
        same = (now.keyframe_id[nodes] == before.keyframe_id[nodes]).all()
        if same and (now.keyframe_robot[nodes] == before.keyframe_robot[nodes]).all():
            return nodes
    order = np.lexsort((now.keyframe_id, now.keyframe_robot))
    keys = zip(before.keyframe_robot[nodes].tolist(), before.keyframe_id[nodes].tolist(), strict=True)

    def key_of(node: int) -> tuple[int, int]:
        return int(now.keyframe_robot[node]), int(now.keyframe_id[node])

    return np.array([order[bisect_left(order, key, key=key_of)] for key in keys], dtype=np.int64)
