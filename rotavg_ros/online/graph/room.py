"""Room in the graph for another keyframe or edge: where it is full, what can be spared goes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph

# How full a full graph is after keyframes or closures have been taken out of it: the cost of doing so, which grows
# with the graph, is shared by all that come until it is full again.
_FILL = 0.9
# If less than this share of the limit could be spared, it is not tried again before a tenth of it has come.
_WORTHWHILE = 0.01
# Of how many marginalised keyframes it stays known where they were: so many limits of keyframes, or a few megabytes.
_REMEMBERED = 4
_REMEMBERED_AT_LEAST = 50_000


class GraphsAnswer(Protocol):
    """What has been answered about the graph so far, in the graph's numbers."""

    @property
    def outlier(self) -> NDArray[np.bool_]:
        """Flags ``(m,)`` of the first edges."""

    def renumber(self, renumbering: Renumbering) -> None:
        """Follow the graph."""


@dataclass
class Room:
    """Compacts a graph that is full.

    Attributes:
        marginalized, dropped_closures: how many keyframes and closures were taken out so far.
        compact_from_revision: of the graph, for keyframes and for edges; before it nothing more can be spared.
    """

    marginalized: int = 0
    dropped_closures: int = 0
    compact_from_revision: list[int] = field(default_factory=lambda: [0, 0])

    def is_full(self, graph: GrowingViewGraph, max_keyframes: int) -> bool:
        """Whether there may be no more keyframes, though whatever can be spared has been taken out."""
        return graph.num_keyframes >= max_keyframes and graph.revision < self.compact_from_revision[0]

    def try_again(self) -> None:
        """The limits have changed."""
        self.compact_from_revision = [0, 0]

    def make(
        self, graph: GrowingViewGraph, max_keyframes: int, max_edges: int, answer: GraphsAnswer, needed: Sequence[int]
    ) -> bool:
        """Take keyframes and closures that can be spared out of a full graph; whether there were any.

        Args:
            graph: perhaps full.
            max_keyframes, max_edges: what it may have.
            answer: to it.
            needed: nodes that cannot be spared, whatever their place among the robots' keyframes.
        """
        sizes, limits = (graph.num_keyframes, graph.num_edges), (max_keyframes, max_edges)
        surplus = [
            size - int(_FILL * limit) if size >= limit and graph.revision >= from_revision else 0
            for size, limit, from_revision in zip(sizes, limits, self.compact_from_revision, strict=True)
        ]
        if not any(surplus):
            return False
        remembered = max(_REMEMBERED * max_keyframes, _REMEMBERED_AT_LEAST)
        renumbering = graph.compact(surplus[0], surplus[1], answer.outlier, remembered, needed)
        gained = sizes[0] - graph.num_keyframes, sizes[1] - graph.num_edges
        for index, limit in enumerate(limits):
            if surplus[index] and gained[index] < max(1, _WORTHWHILE * limit):
                self.compact_from_revision[index] = graph.revision + max(1, round((1 - _FILL) * limit))
        if renumbering is None:
            return False
        self.marginalized += gained[0]
        self.dropped_closures += renumbering.num_dropped
        answer.renumber(renumbering)
        return True
