"""A robot's graph by its posterior: starts and moves, with a gyroscope's bias or without, and what is published."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.odometry_lengths import ways_passed
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.routes import way_along
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.noise.turns import squared_turns
from rotavg_ros.solver.slam.posterior.bias import Bias
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.preparation import Prepared, likely_bias, prepare_as_it_is
from rotavg_ros.solver.slam.stages import CleanedClosures, clean
from rotavg_ros.view_graph import ViewGraph

# A bias is made better so many times at most, as long as F falls by more than this, nats.
_BIAS_ROUNDS, _LEAST_GAIN = 3, 0.5
# Units of work for each edge of what a problem is told beforehand.
_EDGE = 0.002


@dataclass(frozen=True)
class Drawn:
    """A graph drawn together, and its problem.

    Attributes:
        prepared: without the bias, if there is one.
        cleaned: what CleanNet says of its closures.
        problem: the posterior's view of it.
    """

    prepared: Prepared
    cleaned: CleanedClosures
    problem: Problem

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        network: SlamCleanNet | None,
        without: Collection[str] = (),
        bias: np.ndarray | None = None,
        priors: SlamPriors | None = None,
    ) -> Drawn:
        """After ``bias`` ``(3,)`` rad per step is taken out of the odometry."""
        corrected = graph if bias is None else without_bias(graph, bias)
        prepared = prepare_as_it_is(corrected)
        cleaned = clean(network, prepared, graph.label)
        spend(_EDGE * graph.num_edges)
        of_bias = None if bias is None else Bias.of(corrected, prepared, bias)
        turned = squared_turns(corrected, prepared.forest, prepared.noise.step_variance)
        problem = Problem.of(
            prepared, cleaned.network_log_odds, priors=priors, without=without, bias=of_bias, turned=turned
        )
        problem = replace(problem, travelled=_travelled(graph, prepared))
        return cls(prepared, cleaned, problem)

    def orientations(self, state: State) -> Tensor:
        """``(N, 4)`` body_from_world."""
        return self.problem.drawn(state.noise).orientations(torch.from_numpy(np.ascontiguousarray(state.correction.T)))


@dataclass(frozen=True)
class Found:
    """What the search found, the least F first."""

    drawn: Drawn
    modes: list[Mode]

    @property
    def cost(self) -> float:
        """F of the best mode, nats."""
        return self.modes[0].cost

    @property
    def bias(self) -> np.ndarray | None:
        """``(3,)`` rad per step that was taken out of the odometry, if any was."""
        bias = self.drawn.problem.bias
        return None if bias is None else bias.vector


Begin = Callable[[Prepared, CleanedClosures], Tensor]


def search(
    graph: ViewGraph,
    network: SlamCleanNet | None,
    begin: Begin,
    without: Collection[str] = (),
    priors: SlamPriors | None = None,
) -> Found:
    """The labellings of least F of a graph that states nothing twice.

    Args:
        graph: N nodes.
        network: CleanNet, or None without it.
        begin: corrections ``(K, 4)`` to begin with: along CleanNet's tree, or of an earlier answer.
        without: terms and moves that are switched off.
        priors: other ones than usual.
    """

    def from_starts(drawn: Drawn) -> Found:
        correction = begin(drawn.prepared, drawn.cleaned)
        begun = Search(drawn.problem)
        begun.run(drawn.prepared, drawn.cleaned, correction)
        return Found(drawn, begun.modes)

    found = from_starts(Drawn.of(graph, network, without, None, priors))
    if "bias" in without:
        return found
    if (bias := likely_bias(graph, found.drawn.prepared)) is not None:
        biased = from_starts(Drawn.of(graph, network, without, bias, priors))
        found = min(found, biased, key=lambda either: either.cost)
    for _ in range(_BIAS_ROUNDS):
        better = _with_better_bias(graph, network, found, without)
        if better is None:
            break
        found = better
    return found


def _with_better_bias(
    graph: ViewGraph, network: SlamCleanNet | None, found: Found, without: Collection[str]
) -> Found | None:
    """What is found from the best mode with Newton's step on the bias; None if F does not fall by it."""
    best, drawn = found.modes[0], found.drawn
    problem, evaluation = best.problem, best.evaluation
    bias = problem.bias or Bias.of(graph, drawn.prepared, np.zeros(3))
    information, change = bias.information(
        problem.graph.source, best.state, evaluation.residual, evaluation.factorised, problem.priors
    )
    predicted = -float(change @ information @ change) / 2
    if problem.bias is None:
        predicted += bias.cost(information, problem.priors)
    if predicted > -_LEAST_GAIN:
        return None
    again = Drawn.of(graph, network, without, bias.vector + change @ bias.axes, problem.priors)
    moved = _moved(best, drawn, again)
    goes_on = Search(again.problem)
    goes_on.keep(goes_on.flipped(goes_on.polished(moved, "bias")))
    goes_on.move_on()
    better = Found(again, goes_on.modes)
    return None if better.cost > found.cost - _LEAST_GAIN else better


def _travelled(graph: ViewGraph, prepared: Prepared) -> np.ndarray | None:
    """``(N,)`` metres of odometry from each node's root on; None unless all of it is known."""
    if graph.translation is None:
        return None
    length = torch.from_numpy(ways_passed(graph.translation.double().numpy(), way_along(graph)))
    if not bool(torch.isfinite(length[graph.is_odometry]).all()):
        return None
    return _from_root(torch.where(graph.is_odometry, length, 0.0), prepared)


def _from_root(of_edge: Tensor, prepared: Prepared) -> np.ndarray:
    """``(N,)`` sums of values ``(M,)`` of edges along the forest, from each node's root on."""
    parent_edge = prepared.forest.parent_edge
    return accumulate_to_root(prepared.forest, np.where(parent_edge >= 0, of_edge.double().numpy()[parent_edge], 0.0))


def _moved(mode: Mode, before: Drawn, after: Drawn) -> State:
    """A mode's labels, noise and orientations on the same graph drawn together anew."""
    correction = after.prepared.closure_graph.corrections(before.orientations(mode.state))
    return replace(mode.state, correction=np.ascontiguousarray(correction.numpy().T))
