"""A graph's odometry by itself, with which answers and closures are compared."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.spanning_forest import (
    SpanningForest,
    accumulate_to_root,
    compose_orientations,
    shortest_path_forest,
)
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Number of odometry edges along which closures may be false by one mistake: of a stretch that looks like another.
STRETCH = 30
# Maps quaternions as stored, target_from_source ``(n, 4)``, to their reading under a hypothesis.
Reading = Callable[[Tensor], Tensor]


def unchanged(quaternions: Tensor) -> Tensor:
    """The reading that changes nothing."""
    return quaternions


@dataclass(frozen=True)
class Odometry:
    """The odometry edges of a graph that are not labelled as rejected.

    Attributes:
        graph: all nodes, and these edges only.
        forest: spanning forest with the fewest edges to each root, which is an end of its chain, wherever the first
            node lies.
    """

    graph: ViewGraph
    forest: SpanningForest

    @classmethod
    def of(cls, graph: ViewGraph) -> Odometry:
        usable = graph.is_odometry & (graph.label != EdgeLabel.REJECTED)
        alone = graph.select_edges(usable.nonzero()[:, 0])
        begun = shortest_path_forest(alone, root="first")
        ends = torch.from_numpy(_farthest(begun))
        return cls(alone, shortest_path_forest(alone, root=ends, component=torch.from_numpy(begun.component)))

    @property
    def component(self) -> Tensor:
        """``(N,)`` components that odometry alone connects, numbered by first node."""
        return torch.from_numpy(self.forest.component)

    def level(self) -> Tensor:
        """``(N,)`` number of edges from the root: path lengths along a chain are differences of these."""
        return torch.from_numpy(_level(self.forest))

    def median_angle(self, reading: Reading) -> float:
        """Median angle of its edges, in radians."""
        cosine = reading(self.graph.target_from_source)[:, 3].abs()
        return 2 * math.acos(min(float(cosine.median()), 1.0)) if len(cosine) else 0.0

    @cached_property
    def orientation(self) -> Tensor:
        """``(N, 4)`` body_from_world composed along it."""
        return compose_orientations(self.forest, self.graph)

    def read_as(self, reading: Reading) -> Tensor:
        """The same under another reading."""
        if reading is unchanged:
            return self.orientation
        read = reading(self.graph.target_from_source)
        return compose_orientations(self.forest, replace(self.graph, target_from_source=read))


def _level(forest: SpanningForest) -> np.ndarray:
    """``(N,)`` number of edges from each node's root."""
    return accumulate_to_root(forest, (forest.parent_edge >= 0) * 1.0)


def _farthest(forest: SpanningForest) -> np.ndarray:
    """``(C,)`` the node with most edges to the root of each component; of several, the first."""
    order = np.lexsort((-_level(forest), forest.component))
    return np.asarray(order[np.unique(forest.component[order], return_index=True)[1]])
