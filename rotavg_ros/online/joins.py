"""Components that have become one since the last answer."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.online.answer import Answer


@dataclass(frozen=True)
class Join:
    """Components whose relative orientation was arbitrary until now.

    Attributes:
        robots: names of those that have keyframes in them, sorted; one alone: pieces of its track.
        num_components: how many became one.
    """

    robots: tuple[str, ...]
    num_components: int

    def __str__(self) -> str:
        if len(self.robots) == 1:
            return f"{self.num_components} pieces of {self.robots[0]}'s track are joined"
        return f"{', '.join(self.robots[:-1])} and {self.robots[-1]} are joined"


def joins(before: Answer, now: Answer) -> list[Join]:
    """What has been joined between an answer and a later one about the same, grown graph."""
    old = before.component
    first_nodes = np.unique(old, return_index=True)[1]
    component_now = now.component[first_nodes]
    found = []
    for component in np.flatnonzero(np.bincount(component_now) > 1):
        parts = np.flatnonzero(component_now == component)
        robots = {before.robots[robot] for robot in np.unique(before.keyframe_robot[np.isin(old, parts)])}
        found.append(Join(tuple(sorted(robots)), len(parts)))
    return found
