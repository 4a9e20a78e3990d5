"""What a SLAM solve remembers for the next one of the same graph, grown by a handful of edges.

A node's tick that judged ten thousand closures need not judge them from nothing when five more have come: their
verdicts, the noise and the order of elimination are still right. New closures are judged by their neighbours as ever;
then a few passes of the refinement go on from where the last ones ended. All closures are judged again in these, so
that a verdict can still change; when several do, or the graph has grown by some percent, or some number of updates
later, the whole solve runs again, and with it the search for slips and biases.

An update of a large graph *follows* the one before: it solves from an earlier factorisation (``grown_laplacian.py``),
believes its noise, and takes what the rest of the graph predicts of an old closure, and the uncertainty of an old
keyframe, to be what they were. An update of a small one *renews* these.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import torch

from rotavg_ros.solver.algebra.laplacian import LaplacianPattern
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph, contract_along
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.solver.slam.noise.stated_precision import StatedTrust, believing
from rotavg_ros.solver.slam.passes.alternation import SlamEstimate, Verdicts
from rotavg_ros.solver.slam.passes.system import ITERATING_PAYS, StaleFactorError
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.preparation import Prepared, draw_together
from rotavg_ros.solver.slam.stages import CleanedClosures
from rotavg_ros.solver.slam.update.grown_edges import begins_with, carried_over
from rotavg_ros.solver.slam.update.grown_laplacian import GrownLaplacian, OlderFactor
from rotavg_ros.solver.slam.update.grown_system import GrownSystem
from rotavg_ros.solver.slam.update.new_closures import judge_new_closures
from rotavg_ros.solver.slam.update.passes import GrownStart, follow, grown_variance, renew
from rotavg_ros.view_graph import ViewGraph

_NEXT_TO_NOTHING = 1e-9


@dataclass(frozen=True)
class UpdateLimits:
    """How far updates go before the whole solve runs again, and what they may cost.

    Attributes:
        updates: the whole solve runs again after so many.
        growth: … or once there are more closures by this share. Of few closures that is none: while little is known,
            each new one may change what is believed of the others.
        turned, share_turned: … or when more verdicts turn in an update than either.
        columns: new closures that an update solves for from an older factorisation; with more, another one is cheaper.
            If so many are new at once, the whole solve runs.
        large_graph: key nodes; a graph of fewer is factorised anew in each update.
        entries: a factorisation with more entries of 12 bytes per node and edge is not kept.
    """

    updates: int = 60
    growth: float = 0.05
    turned: int = 2
    share_turned: float = 0.002
    columns: int = 128
    large_graph: int = ITERATING_PAYS
    entries: int = 24


class Updated(NamedTuple):
    """The outcome of an update: the closure graph, its verdicts, and variance ``(N,)`` of the nodes in rad²."""

    closure_graph: ClosureGraph
    verdicts: Verdicts
    variance: np.ndarray
    memory: SlamMemory


@dataclass(frozen=True)
class WholeSolveMemory:
    """Where an update could not go on: the next solve is a whole one, and begins with these poses."""

    graph: ViewGraph
    poses: PoseMemory


@dataclass(frozen=True)
class SlamMemory:
    """Of a graph of N nodes and M edges.

    Attributes:
        graph: the view-graph.
        inlier_probability: ``(M,)`` that an edge is not a false one; all of a segment have that of the segment.
        outlier_probability: ``(M,)`` that its true noise exceeds 10°, likewise.
        network_log_odds: ``(M,)`` what the network said of closures; ±inf by label.
        steps: ``(M,)`` variance by which a closure weighs in units of the closures', see
            :class:`~rotavg_ros.solver.slam.graph.closure_graph.ClosureGraph`.
        trust: how far the variances that closures state are believed.
        exact_share: ``(M,)`` probability of a good closure to err no more than most.
        prediction_variance: ``(M,)`` rad², of what the rest of the graph predicts of a closure.
        variance: ``(N,)`` rad², of the orientations.
        chain_noise: the noise as the odometry has it.
        noise: the noise as the refinement left it.
        max_step_variance: rad², as the refinement kept it.
        elimination: ``(K,)`` nodes in the order of elimination; None if there was none.
        paths: of the closure graph.
        factor: what the next update may solve from; None where it factorises anew.
        closures: how many there were when the whole solve ran.
        updates: how many there have been since.
        limits: of the updates.
        warnings: about the answer of the whole solve.
        poses: where translations are known.
    """

    graph: ViewGraph
    inlier_probability: np.ndarray
    outlier_probability: np.ndarray
    network_log_odds: np.ndarray
    steps: np.ndarray
    trust: StatedTrust
    exact_share: np.ndarray
    prediction_variance: np.ndarray
    variance: np.ndarray
    chain_noise: NoiseModel
    noise: NoiseModel
    max_step_variance: float
    elimination: np.ndarray | None
    paths: OdometryPaths
    factor: OlderFactor | None
    closures: int
    updates: int = 0
    limits: UpdateLimits = field(default_factory=UpdateLimits)
    warnings: tuple[str, ...] = ()
    poses: PoseMemory | None = None

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        prepared: Prepared,
        cleaned: CleanedClosures,
        estimate: SlamEstimate,
        variance: np.ndarray,
    ) -> SlamMemory | None:
        """After a whole solve, with variances of the nodes ``(N,)``; None where an update could not go on from it."""
        closure_graph = prepared.closure_graph
        closures = int(closure_graph.is_closure.sum())
        if prepared.is_unbiased:
            return None
        return cls(
            **_by_edge(closure_graph, estimate, cleaned.network_log_odds),
            **_of_estimate(graph, closure_graph, estimate, UpdateLimits()),
            graph=graph,
            variance=variance,
            trust=estimate.trust,
            chain_noise=prepared.noise,
            max_step_variance=estimate.max_step_variance,
            closures=closures,
        )

    def updated(self, graph: ViewGraph, network: SlamCleanNet | None, body_from_world: torch.Tensor) -> Updated | None:
        """Solve a graph that has grown from this one; None if it has not, or the whole solve should run.

        Args:
            body_from_world: ``(N, 4)`` start.
        """
        if self.updates >= self.limits.updates or not begins_with(graph, self.graph):
            return None
        num_closures = int((~graph.is_odometry).sum())
        num_new = num_closures - int((~self.graph.is_odometry).sum())
        if num_closures > (1 + self.limits.growth) * self.closures or num_new > self.limits.columns:
            return None
        paths = self.paths.grown(graph)
        closure_graph = draw_together(graph)[0] if paths is None else contract_along(graph, paths)
        start = self._start(closure_graph, network, body_from_world)
        if paths is not None and not start.is_new.any():
            return self._extend(graph, start)
        updated = self._follow(graph, start) or self._renew(graph, start)
        if updated is None:
            return None
        turned = np.abs(updated.verdicts.inlier_probability - start.inlier_probability) > 0.5
        turned[start.is_new] = False
        return None if turned.sum() > max(self.limits.turned, self.limits.share_turned * num_closures) else updated

    def _extend(self, graph: ViewGraph, start: GrownStart) -> Updated:
        """With odometry alone, which says nothing of what was there."""
        closure_graph = start.graph
        outlier_probability = carried_over(self.outlier_probability, closure_graph, 0.0)
        verdicts = Verdicts(
            start.correction,
            start.inlier_probability,
            np.where(closure_graph.is_closure, outlier_probability, 1 - start.inlier_probability),
            self.noise,
            closure_graph.steps,
            start.exact_share,
            start.prediction_variance,
        )
        return self._updated(graph, start, verdicts, self.factor)

    def _follow(self, graph: ViewGraph, start: GrownStart) -> Updated | None:
        """With noise and predictions of before; None where they are not for that, or no longer serve."""
        if start.graph.num_nodes < self.limits.large_graph:
            return None
        closure_graph, weight, verdicts = start.graph, start.weight, None
        for older in self._factors(start, weight):
            laplacian = GrownLaplacian(older, closure_graph, weight)
            with suppress(StaleFactorError):
                verdicts = follow(start, GrownSystem(laplacian, start.prediction_variance))
                break
        if verdicts is None:
            return None
        return self._updated(graph, start, verdicts, _if_small(laplacian.factor, graph, self.limits))

    def _updated(self, graph: ViewGraph, start: GrownStart, verdicts: Verdicts, factor: OlderFactor | None) -> Updated:
        """With the noise and predictions of before."""
        variance = grown_variance(self.variance, start.graph, start.weight)
        by_edge = _by_edge(start.graph, verdicts, start.network_log_odds)
        memory = replace(self, **by_edge, graph=graph, variance=variance, factor=factor, updates=self.updates + 1)
        return Updated(start.graph, verdicts, variance, memory)

    def _factors(self, start: GrownStart, weight: np.ndarray) -> Iterator[OlderFactor]:
        """What may be solved from: the factor there is, as long as not too much is new, and another one."""
        graph, older = start.graph, self.factor
        if (
            older is not None
            and older.fits(graph)
            and (graph.view_graph_edge >= older.num_edges).sum() <= self.limits.columns
        ):
            yield older
        pattern = LaplacianPattern(graph.num_nodes, graph.source, graph.target, graph.roots, self._rank(graph))
        # Without what has just come, so that predictions of it are exact.
        factorised = pattern.factorize(np.where(self._came_later(graph), _NEXT_TO_NOTHING * weight, weight))
        yield replace(OlderFactor.of(graph, factorised), num_edges=self.graph.num_edges)

    def _renew(self, graph: ViewGraph, start: GrownStart) -> Updated | None:
        """Factorised and estimated anew; None if orientations turn by too much."""
        closure_graph = start.graph
        estimate = renew(start, self._rank(closure_graph), self.trust, self.max_step_variance)
        if estimate is None:
            return None
        variance = closure_graph.variance(estimate.samples, estimate.stated_step_variance)
        memory = replace(
            self,
            **_by_edge(closure_graph, estimate, start.network_log_odds),
            **_of_estimate(graph, closure_graph, estimate, self.limits),
            graph=graph,
            variance=variance,
            updates=self.updates + 1,
        )
        return Updated(closure_graph, estimate, variance, memory)

    def _start(self, graph: ClosureGraph, network: SlamCleanNet | None, body_from_world: torch.Tensor) -> GrownStart:
        """What is known of all edges, and of new closures what those around them say."""
        closure = np.flatnonzero(graph.is_closure)
        is_new = graph.is_closure & self._came_later(graph)
        new = np.flatnonzero(is_new)
        inlier_probability, prior = (
            carried_over(value, graph, otherwise)
            for value, otherwise in ((self.inlier_probability, 1.0), (self.network_log_odds, 0.0))
        )
        graph = believing(graph, self.trust)
        # By how much a closure weighs less for those that err as it does.
        factor = np.ones(len(graph.source))
        factor[closure] = carried_over(self.steps, graph, 1.0)[closure] / graph.own_steps[closure]
        if len(new):
            judged = judge_new_closures(network, self.chain_noise, graph, closure, new, factor)
            inlier_probability[new], prior[new], factor[new] = judged
        return GrownStart(
            replace(graph, steps=factor * graph.own_steps),
            graph.corrections(body_from_world),
            inlier_probability,
            self.noise,
            prior,
            exact_share=carried_over(self.exact_share, graph, 1.0),
            is_new=is_new,
            prediction_variance=carried_over(self.prediction_variance, graph, 0.0),
        )

    def _came_later(self, graph: ClosureGraph) -> np.ndarray:
        """Edges ``(E,)`` outside the forest that this knows nothing of."""
        return np.append(np.zeros(graph.num_segments, dtype=bool), graph.view_graph_edge >= self.graph.num_edges)

    def _rank(self, graph: ClosureGraph) -> np.ndarray | None:
        """Order of elimination ``(K,)``: as it was, and what is new comes last."""
        if self.elimination is None:
            return None
        place = np.full(len(graph.odometry_orientation), np.iinfo(np.int64).max)
        place[self.elimination] = np.arange(len(self.elimination))
        rank = np.empty(graph.num_nodes, dtype=np.int64)
        rank[np.argsort(place[graph.nodes], kind="stable")] = np.arange(graph.num_nodes)
        return rank


def _by_edge(graph: ClosureGraph, verdicts: Verdicts, network_log_odds: np.ndarray) -> dict[str, Any]:
    """What is remembered of every edge of the view-graph, ``(M,)`` each."""
    return {
        "inlier_probability": graph.edge_values(verdicts.inlier_probability),
        "outlier_probability": graph.edge_values(verdicts.outlier_probability),
        "network_log_odds": graph.edge_values(network_log_odds),
        "steps": graph.edge_values(verdicts.steps),
        "exact_share": graph.edge_values(verdicts.exact_share),
        "prediction_variance": graph.edge_values(verdicts.prediction_variance),
        "paths": graph.paths,
    }


def _of_estimate(
    graph: ViewGraph, closure_graph: ClosureGraph, estimate: SlamEstimate, limits: UpdateLimits
) -> dict[str, Any]:
    """What is remembered of the passes."""
    is_large = closure_graph.num_nodes >= limits.large_graph
    factor = OlderFactor.of(closure_graph, estimate.factorised) if is_large else None
    return {
        "noise": estimate.noise,
        "elimination": None if estimate.rank is None else closure_graph.nodes[np.argsort(estimate.rank)],
        "factor": None if factor is None else _if_small(factor, graph, limits),
    }


def _if_small(factor: OlderFactor, graph: ViewGraph, limits: UpdateLimits) -> OlderFactor | None:
    """What is worth its memory."""
    return factor if factor.num_entries <= limits.entries * (graph.num_nodes + graph.num_edges) else None
