"""What a tick solves: a graph, and the last answer as far as it goes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online.answer.gauge import extend_along_edges, joins_components
from rotavg_ros.online.graph.snapshot import GraphSnapshot

# While data flows, a flag changes only if the score passes the threshold by this share of the way to 0 or 1: on a
# real robot's graph that halves the changes, and no more flags are wrong.
_FLAG_HYSTERESIS = 0.4


@dataclass(frozen=True)
class Problem:
    """Nothing in it changes while it is solved, whatever becomes of the growing graph.

    Attributes:
        snapshot: the graph, of N keyframes and M edges.
        cold: to be solved from scratch.
        answered: body_from_world ``(n, 4)`` of the last answer, for the first keyframes; None before the first.
        component: ``(n,)`` of the last answer; None where it is not known.
        outlier: ``(m,)`` flags of the last answer, of the first edges.
        memory: what the solver remembers of the last answer.
    """

    snapshot: GraphSnapshot
    cold: bool
    answered: Tensor | None
    component: Tensor | None
    outlier: NDArray[np.bool_]
    memory: object | None

    def warm_start(self) -> Tensor | None:
        """The last answer carried on to all keyframes ``(N, 4)``; None where it is no good start."""
        if self.cold or self.answered is None or self.component is None:
            return None
        if joins_components(self.component, self.snapshot.graph.components()):
            return None
        return extend_along_edges(self.answered, self.snapshot.graph)

    def thresholds(self, threshold: float, was_cold: bool) -> NDArray[np.float64]:
        """The score above which each edge is an outlier ``(M,)``; the last answer's flags are kept when in doubt.

        A cold answer depends on the graph alone, so there nothing is kept.
        """
        thresholds = np.full(self.snapshot.graph.num_edges, threshold)
        if not was_cold:
            margin = _FLAG_HYSTERESIS * min(threshold, 1 - threshold)
            thresholds[: len(self.outlier)] += np.where(self.outlier, -margin, margin)
        return thresholds
