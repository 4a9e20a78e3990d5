"""A graph's edges as an estimator gets them: each when its later end exists."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.online.estimator import OnlineEstimator
from rotavg_ros.online.measurements import EdgeMeasurement, KeyframeReference
from rotavg_ros.view_graph import ViewGraph

_ROBOT = "robot"


class Feed:
    """Gives the edges of a graph to an estimator whose keyframes come from the edges.

    Attributes:
        arrival: ``(M,)`` the later end of each.
    """

    def __init__(self, graph: ViewGraph, estimator: OnlineEstimator) -> None:
        self._estimator, self._given = estimator, 0
        self.arrival = torch.maximum(graph.source, graph.target).numpy()
        # Odometry makes the keyframes that closures of the same moment refer to.
        self._order = np.lexsort((~graph.is_odometry.numpy(), self.arrival))
        self._source, self._target = graph.source.tolist(), graph.target.tolist()
        self._rotation, self._kind = graph.target_from_source.tolist(), graph.kind.tolist()
        self._precision = torch.nan_to_num(graph.precision).tolist()
        self._translation = [None] * graph.num_edges if graph.translation is None else graph.translation.tolist()

    def until(self, end: int) -> None:
        """All edges between the first ``end`` nodes that were not given yet."""
        last = int(np.searchsorted(self.arrival[self._order], end))
        for edge in self._order[self._given : last].tolist():
            self._estimator.add_edge(
                EdgeMeasurement(
                    edge,
                    KeyframeReference(_ROBOT, self._source[edge]),
                    KeyframeReference(_ROBOT, self._target[edge]),
                    self._rotation[edge],
                    self._kind[edge],
                    self._precision[edge],
                    self._translation[edge],
                )
            )
        self._given = last
