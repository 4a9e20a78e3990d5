"""Closures that wait to be solved, so that a flood of them takes many short ticks instead of one long one.

The cost of a tick grows with the number of closures that are new in it and the number of false ones in the solve. So
each tick admits a limited number: first those that the last answer explains, the most likely first, then others, those
at the newest keyframes first. The limit counts closures, not seconds, so a bag leads to the same answers on every
machine. If no more of the closures that came together are explained than random ones would be, the explained ones wait
too (:mod:`~rotavg_ros.online.answer.arrivals`). A closure that waits is not part of the solve; its score comes from its
residual (:mod:`~rotavg_ros.online.answer.screening`). While nothing comes, the limit doubles with each tick, until all
are in.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros.online.answer.arrivals import FALSE, GAP, GOOD, Arrivals, beside
from rotavg_ros.online.answer.screening import Known
from rotavg_ros.online.compaction.renumbering import Renumbering
from rotavg_ros.online.compaction.thinning import Way
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph

_MOST_DOUBLINGS = 30


@dataclass(frozen=True)
class EntryLimits:
    """How many closures enter a solve in one tick. Ordinary ticks bring fewer and are not affected.

    Attributes:
        at_least: closures that may enter in any graph. With this many the solver continues from its last answer; with
            many more it begins anew.
        share: further closures that may enter, as a share of those in the solve. The solver begins anew after 5 % more.
        per_keyframe: further closures that may enter for each keyframe that is new since the last answer. A robot that
            drives on, and a graph that is loaded, bring closures with their keyframes; a flood brings them without.
        contradicting: of the closures that enter, the largest share that the last answer may contradict.
        flagged: ratio of flagged to believed closures in the solve. While data flows and the ratio is exceeded,
            contradicted closures enter only at the newest keyframes. Each of them makes every tick dearer.
        newest: number of the last answer's keyframes that count as newest, besides those added since.
    """

    at_least: int = 100
    share: float = 0.01
    per_keyframe: int = 4
    contradicting: float = 0.25
    flagged: float = 0.1
    newest: int = 10


@dataclass
class ClosureQueue:
    """Which of a growing graph's edges wait, and in which order the others have entered the solve.

    Attributes:
        waits: ``(m,)`` which of the first m edges wait, those that were there at the last :meth:`let_in`.
        order: edges that have entered, in that order, by which the solver's memory of its last solve is indexed. None:
            all are in, in their own order.
        idle_ticks: number of ticks in a row without new data while closures waited.
        arrivals: which closures came together.
        prior_log_odds: ``(m,)`` nats, of each waiting closure being good before its own residual counts; 0 for others.
        num_by_chance: number of closures that wait although the last answer explains them, because it would explain
            as many random ones.
        limits: how many may enter in a tick.
    """

    waits: NDArray[np.bool_] = field(default_factory=lambda: np.zeros(0, dtype=bool))
    order: NDArray[np.int64] | None = None
    idle_ticks: int = 0
    arrivals: Arrivals = field(default_factory=Arrivals)
    prior_log_odds: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    num_by_chance: int = 0
    limits: EntryLimits = field(default_factory=EntryLimits)

    def __len__(self) -> int:
        """Number of closures that wait."""
        return int(self.waits.sum())

    def renumber(self, renumbering: Renumbering) -> None:
        """Follow a compaction of the graph, after which the solver's memory fits no longer."""
        self.waits, self.order = renumbering.flags(self.waits), None
        self.arrivals.forget()

    def let_in_all(self, graph: ViewGraph) -> None:
        """The next solve is of the whole graph."""
        self.waits = np.zeros(graph.num_edges, dtype=bool)
        self.order, self.idle_ticks = None, 0
        self.prior_log_odds, self.num_by_chance = np.zeros(graph.num_edges), 0

    def let_in(self, graph: ViewGraph, known: Known | None, outlier: NDArray[np.bool_], *, idle: bool) -> None:
        """Choose what enters the next solve.

        Args:
            graph: N keyframes, M ≥ m edges.
            known: what the last answer knows; None before the first, when all enter. All enter as well where there is
                no odometry, since such a graph grows by closures.
            outlier: ``(m',)`` flags of the last answer, for the first m' edges.
            idle: nothing has come since the last tick.
        """
        self.idle_ticks = self.idle_ticks + 1 if idle and len(self) else 0
        entered = np.flatnonzero(~self.waits) if self.order is None else self.order
        in_own_order = self.order is None and not self.waits.any()
        was_in = np.zeros(graph.num_edges, dtype=bool)
        was_in[entered] = True
        is_closure = graph.kind.numpy() == EdgeKind.LOOP_CLOSURE
        waits = ~was_in & is_closure & (graph.label.numpy() == EdgeLabel.AUTOMATIC)
        self.prior_log_odds, self.num_by_chance = np.zeros(graph.num_edges), 0
        num_known = 0 if known is None else len(known.body_from_world)
        later_end = torch.maximum(graph.source, graph.target).numpy()
        self.arrivals.take(is_closure, later_end >= num_known - self.limits.newest)
        if known is not None and waits.any() and bool(graph.is_odometry.any()):
            flagged = np.zeros(graph.num_edges, dtype=bool)
            flagged[: len(outlier)] = outlier
            waits[self._chosen(graph, waits, known, np.flatnonzero(was_in & is_closure), flagged)] = False
        else:
            waits[:] = False
        self.waits = waits
        self.order = None if in_own_order and not waits.any() else np.concatenate((entered, _new(waits, was_in)))

    def _chosen(
        self,
        graph: ViewGraph,
        waits: NDArray[np.bool_],
        known: Known,
        closures_in: NDArray[np.int64],
        flagged: NDArray[np.bool_],
    ) -> NDArray[np.int64]:
        """Which of the waiting closures ``(M,)`` enter, given those in the solve ``(C,)`` and the flags ``(M,)``."""
        candidates, limits, solved = np.flatnonzero(waits), self.limits, flagged[closures_in]
        num_known = len(known.body_from_world)
        most = limits.at_least + limits.share * len(solved) + limits.per_keyframe * (graph.num_nodes - num_known)
        most = int(most * 2.0 ** min(self.idle_ticks, _MOST_DOUBLINGS))
        if len(candidates) <= most:
            return candidates
        closures = graph.select_edges(torch.from_numpy(candidates))
        told = known.carried_on(graph.select_edges(torch.from_numpy(~waits))).log_odds(closures, graph)
        is_open = candidates[self.arrivals.are_open(candidates, told)]
        self.arrivals.beside[is_open], believed = _beside(graph, is_open, closures_in[~solved])
        prior = self.arrivals.prior_log_odds(candidates, told, believed)
        self.prior_log_odds[candidates] = prior
        is_good = told + prior >= 0
        # The solve would believe these, whatever group they came with.
        would_be = told + np.log(((~solved).sum() + GOOD) / (solved.sum() + FALSE)) >= 0
        self.num_by_chance = int((would_be & ~is_good).sum())
        later_end = torch.maximum(closures.source, closures.target).numpy()
        at_newest = later_end >= num_known - limits.newest
        explained = np.flatnonzero(is_good)
        explained = explained[np.argsort(-(told + prior)[explained], kind="stable")][:most]
        may_enter, spare = ~is_good, most - len(explained)
        if not self.idle_ticks:
            # In a flood of mostly false closures, no contradicted one is worth the solve's time.
            is_ordinary = self.arrivals.num_together(candidates) <= limits.at_least
            may_enter &= ~would_be & (is_ordinary | (prior >= 0))
            spare = min(spare, int(limits.contradicting * most))
            if solved.sum() > max(limits.at_least, limits.flagged * (~solved).sum()):
                may_enter &= at_newest
        others = np.flatnonzero(may_enter)
        others = others[np.lexsort((-told[others], ~at_newest[others]))][:spare]
        return candidates[np.concatenate((explained, others))]


def _beside(graph: ViewGraph, asked: NDArray[np.int64], believed: NDArray[np.int64]) -> Sequence[NDArray[np.int64]]:
    """``(K,)`` how near some closures are to the nearest of ``(B,)`` others, and ``(B,)`` these to each other."""
    names = ("source", "target", "kind", "steps")
    way = Way.along(graph.num_nodes, {name: getattr(graph, name).numpy() for name in names})
    position = way.position + way.chain * (way.length + 3 * GAP)
    ends = np.stack((graph.source.numpy(), graph.target.numpy()), axis=1)
    known = position[ends[believed]]
    return beside(position[ends[asked]], known), beside(known, known, is_one=True)


def _new(waits: NDArray[np.bool_], was_in: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Edges that enter now."""
    return np.flatnonzero(~waits & ~was_in)
