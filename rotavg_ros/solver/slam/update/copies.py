"""Graphs that state some measurements more than once: each is solved once, and the answer is of all edges."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch

from rotavg_ros.solver.estimate import Estimate
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each, without_repeats
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Copies:
    """A graph of M edges that state U < M measurements.

    Attributes:
        graph: the graph.
        first: ``(U,)`` the edges that state something new, ascending.
        says_as: ``(M,)`` the one of these that states the same as each edge.
    """

    graph: ViewGraph
    first: np.ndarray
    says_as: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph) -> Copies | None:
        """The copies in a graph; None if no edge repeats another one."""
        found = first_of_each(graph)
        return None if found is None else cls(graph, *found)

    @property
    def once(self) -> ViewGraph:
        """The graph of U edges."""
        return without_repeats(self.graph, self.first, self.says_as)

    def of_all(self, estimate: Estimate) -> Estimate:
        """The estimate of U edges as one of all M; its memory is the same."""
        says_as = torch.from_numpy(self.says_as)
        places, restated = estimate.places, estimate.restated
        if places is not None:
            # Least squares on all copies counts the measurement once, as the solve does.
            precision = places.precision[says_as] / torch.bincount(says_as)[says_as, None]
            places = replace(places, rotation_score=places.rotation_score[says_as], precision=precision)
        if restated is not None:
            restated = torch.isin(says_as, restated).nonzero()[:, 0]
        return replace(estimate, outlier_score=estimate.outlier_score[says_as], places=places, restated=restated)

    def labels_of_all(self, labels: KeptLabels) -> KeptLabels:
        """The labels of some first of the U edges as those of all M; NaN for edges that say as none of these."""
        is_known = self.says_as < len(labels.trusted)
        says_as = self.says_as[is_known]
        trusted = np.full(len(is_known), np.nan)
        places = np.full((len(labels.places), len(is_known)), np.nan, labels.places.dtype)
        trusted[is_known], places[:, is_known] = labels.trusted[says_as], labels.places[:, says_as]
        return replace(labels, graph=self.graph, trusted=trusted, places=places)

    def labels_once(self, labels: KeptLabels) -> KeptLabels:
        """The labels of the first of the M edges as those of the first of the U."""
        first = self.first[self.first < len(labels.trusted)]
        graph = labels.graph.select_edges(torch.from_numpy(first))
        return replace(labels, graph=graph, trusted=labels.trusted[first], places=labels.places[:, first])
