"""Makes room in a full graph for another keyframe or edge by taking out what can be spared."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.graph.growing_view_graph import GrowingViewGraph

# Share of the limit that a full graph is reduced to. The cost of doing so, which grows with the graph, is thus spread
# over all keyframes or edges that come until it is full again.
_FILL = 0.9
# If less than this share of the limit could be spared, the next attempt waits for a tenth of the limit of changes.
_WORTHWHILE = 0.01
# Positions of up to 4 x max_keyframes marginalised keyframes are remembered, and at least of 50 000 (a few megabytes).
_REMEMBERED = 4
_REMEMBERED_AT_LEAST = 50_000


class GraphsAnswer(Protocol):
    """What has been answered about the graph so far, in the graph's numbering."""

    @property
    def verdict(self) -> NDArray[np.int8]:
        """:class:`~rotavg_ros.online.compaction.thinning.Verdict` on the first m edges ``(m,)``."""

    def renumber(self, renumbering: Renumbering) -> None:
        """Follow a compaction of the graph."""


@dataclass
class Room:
    """Compacts a graph that is full.

    Attributes:
        marginalized, dropped_closures: numbers of keyframes and closures taken out so far.
        compact_from_revision: graph revision from which the next attempt is made, for keyframes and for edges.
    """

    marginalized: int = 0
    dropped_closures: int = 0
    compact_from_revision: list[int] = field(default_factory=lambda: [0, 0])

    def is_full(self, graph: GrowingViewGraph, max_keyframes: int) -> bool:
        """Whether no keyframe can be added, even after everything that can be spared has been taken out."""
        return graph.num_keyframes >= max_keyframes and graph.revision < self.compact_from_revision[0]

    def is_full_of_edges(self, graph: GrowingViewGraph, max_edges: int) -> bool:
        """Whether no edge of others can be added, likewise."""
        return graph.num_edges >= max_edges and graph.revision < self.compact_from_revision[1]

    def try_again(self) -> None:
        """Attempt again from now on, since the limits have changed."""
        self.compact_from_revision = [0, 0]

    def make(
        self, graph: GrowingViewGraph, max_keyframes: int, max_edges: int, answer: GraphsAnswer, needed: Sequence[int]
    ) -> Renumbering | None:
        """Take keyframes and closures that can be spared out of a full graph; returns None if there were none.

        Args:
            graph: the graph, full or not.
            max_keyframes, max_edges: its limits.
            answer: the answer about it.
            needed: nodes that cannot be spared, wherever they are among the robots' keyframes.
        """
        sizes, limits = (graph.num_keyframes, graph.num_edges), (max_keyframes, max_edges)
        surplus = [
            size - int(_FILL * limit) if size >= limit and graph.revision >= from_revision else 0
            for size, limit, from_revision in zip(sizes, limits, self.compact_from_revision, strict=True)
        ]
        if not any(surplus):
            return None
        remembered = max(_REMEMBERED * max_keyframes, _REMEMBERED_AT_LEAST)
        renumbering = graph.compact(surplus[0], surplus[1], answer.verdict, remembered, needed)
        gained = sizes[0] - graph.num_keyframes, sizes[1] - graph.num_edges
        for index, limit in enumerate(limits):
            if surplus[index] and gained[index] < max(1, _WORTHWHILE * limit):
                self.compact_from_revision[index] = graph.revision + max(1, round((1 - _FILL) * limit))
        if renumbering is None:
            return None
        self.marginalized += gained[0]
        self.dropped_closures += renumbering.num_dropped
        answer.renumber(renumbering)
        return renumbering
