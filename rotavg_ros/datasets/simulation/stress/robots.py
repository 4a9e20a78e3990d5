"""Several robots in one world, whose odometry chains are joined only by closures."""

from __future__ import annotations

import numpy as np

from rotavg_ros.datasets.simulation.stress.drawn import DrawnGraph


def separated(count: int, drawn: DrawnGraph, _: np.random.Generator) -> DrawnGraph:
    """One long drive as if by ``count`` robots: the odometry edges where the next one takes over are left out."""
    first, last = drawn.ends
    robot = np.arange(drawn.graph.num_nodes) * count // drawn.graph.num_nodes
    return drawn.selected(drawn.is_closure | (robot[first] == robot[last]))
