"""What a tick solves: a graph, and the last answer to its first part."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from rotavg_ros.online.answer.gauge import extend_along_edges, joined, joins_components
from rotavg_ros.online.answer.screening import Known, score_of
from rotavg_ros.online.graph.snapshot import GraphSnapshot
from rotavg_ros.solver import KeptLabels
from rotavg_ros.solver.solution import Solution
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

# While data flows, a flag changes only if the score passes the threshold by this share of the distance to 0 or 1, the
# smaller one. On a real robot's graph that halves the number of changes, and no more flags are wrong.
_FLAG_HYSTERESIS = 0.4


@dataclass(frozen=True)
class Problem:
    """The problem of one tick. Nothing in it changes while it is solved, even if the graph goes on growing.

    Attributes:
        snapshot: the graph, of N keyframes and M edges.
        cold: whether to solve from scratch.
        answered: body_from_world ``(n, 4)`` of the last answer, for the first n keyframes; None before the first.
        component: ``(n,)`` of the last answer; None where it is not known.
        outlier: ``(m,)`` flags of the last answer, for the first m edges.
        memory: what the solver remembers of the last answer.
        order: edges to solve, in the order in which they have entered; None: all, in their own order. The others wait.
        prior_log_odds: ``(M,)`` nats, of each waiting closure being good before its own residual counts.
        anew: nothing is new, and the answer is to become that of a solve from scratch.
        are_tied_anew: whether some of the edges have been tied to other keyframes since :attr:`memory`.
    """

    snapshot: GraphSnapshot
    cold: bool
    answered: Tensor | None
    component: Tensor | None
    outlier: NDArray[np.bool_]
    memory: object | None
    order: NDArray[np.int64] | None = None
    prior_log_odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    anew: bool = False
    are_tied_anew: bool = False

    @cached_property
    def graph(self) -> ViewGraph:
        """What is solved: all keyframes, and the edges that have entered."""
        graph = self.snapshot.graph
        return graph if self.order is None else graph.select_edges(torch.from_numpy(self.order))

    @cached_property
    def waits(self) -> NDArray[np.bool_]:
        """Closures that are not solved yet ``(M,)``."""
        waits = np.full(self.snapshot.graph.num_edges, self.order is not None)
        if self.order is not None:
            waits[self.order] = False
        return waits

    @cached_property
    def joins(self) -> bool:
        """Whether components of the last answer have become one."""
        return self.component is not None and joins_components(self.component, self.graph.components())

    @cached_property
    def goes_on_from(self) -> object | None:
        """The part of :attr:`memory` that the solver is given.

        Only the labels where components have become one, or edges have been tied anew.
        """
        if self.are_tied_anew:
            return _labels_of_others(self.memory, self.graph)
        return getattr(self.memory, "labels", None) if self.joins else self.memory

    def warm_start(self) -> Tensor | None:
        """The last answer carried on to all keyframes ``(N, 4)``; None where it is no good start."""
        if self.cold or self.answered is None or self.component is None:
            return None
        if not self.joins:
            return extend_along_edges(self.answered, self.graph)
        return None if self.goes_on_from is None else joined(self.answered, self.component, self.graph)

    def thresholds(self, threshold: float, was_cold: bool) -> NDArray[np.float64]:
        """The score above which each edge is an outlier ``(M,)``, with a hysteresis that favours the last flags.

        A cold answer depends on the graph alone, so it has no hysteresis.
        """
        thresholds = np.full(self.snapshot.graph.num_edges, threshold)
        if not was_cold:
            margin = _FLAG_HYSTERESIS * min(threshold, 1 - threshold)
            thresholds[: len(self.outlier)] += np.where(self.outlier, -margin, margin)
        return thresholds

    def known(self, solution: Solution, threshold: float) -> Known:
        """What is needed from a solution of :attr:`graph` to judge closures that are not part of it."""
        believed = solution.outlier_score.cpu().numpy() <= threshold
        believed &= self.graph.kind.numpy() == EdgeKind.LOOP_CLOSURE
        believed &= self.graph.label.numpy() != EdgeLabel.REJECTED
        return Known.of_solution(self.graph, solution, believed)

    def of_all_edges(self, solution: Solution, known: Known) -> Solution:
        """Extend a solution of :attr:`graph` to the whole graph: waiting edges get scores by residual, and no weight.

        Args:
            solution: of M' edges.
            known: from that solution, see :meth:`known`.
        """
        if self.order is None:
            return solution
        graph, order, waits = self.snapshot.graph, torch.from_numpy(self.order), torch.from_numpy(self.waits)
        score = torch.empty(graph.num_edges, dtype=torch.float64)
        score[order] = solution.outlier_score.cpu().double()
        log_odds = known.log_odds(graph.select_edges(waits), graph) + self.prior_log_odds[self.waits]
        score[waits] = torch.from_numpy(score_of(log_odds))
        rotation_score, precision = solution.rotation_score, solution.edge_precision
        if rotation_score is not None:
            rotation_score = score.clone().index_copy(0, order, rotation_score.cpu())
        if precision is not None:
            precision = precision.new_zeros(graph.num_edges, 2).cpu().index_copy(0, order, precision.cpu())
        return replace(solution, outlier_score=score, rotation_score=rotation_score, edge_precision=precision)


def _labels_of_others(memory: object | None, graph: ViewGraph) -> KeptLabels | None:
    """The labels in a solver's memory, without those of edges that are tied to other keyframes by now, or otherwise."""
    kept: KeptLabels | None = getattr(memory, "labels", None)
    if kept is None or len(kept.trusted) > graph.num_edges:
        return None
    pairs = [
        (getattr(graph, name)[: len(kept.trusted)], getattr(kept.graph, name)[: len(kept.trusted)])
        for name in ("source", "target", "target_from_source")
    ]
    moved = np.any([(now != before).reshape(len(now), -1).any(dim=1).numpy() for now, before in pairs], axis=0)
    trusted, places = np.where(moved, np.nan, kept.trusted), np.where(moved, np.nan, kept.places)
    return replace(kept, graph=graph, trusted=trusted, places=places)
