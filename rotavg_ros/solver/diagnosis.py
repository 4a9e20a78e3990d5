"""Tells errors of the search from errors of the model: solves a robot's graph as usual, and from the truth."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.neurora.network_store import Networks
from rotavg_ros.solver.slam import stages as slam_stages
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.moves.noise import tuned
from rotavg_ros.solver.slam.posterior.moves.starts import at, initial_noise
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.publishing.modes import of_mode, publish
from rotavg_ros.solver.slam.posterior.solve import Drawn, Found, search
from rotavg_ros.view_graph import ViewGraph

__all__ = ["Comparison", "SlamPriors", "compare_with_truth", "from_truth", "orientations_under"]


@dataclass(frozen=True)
class Comparison:
    """The search's result, and its result from the truth by single flips alone (N nodes).

    Attributes:
        found: ``(N, 4)`` body_from_world as published.
        from_truth: ``(N, 4)``.
        rise: F of the best labelling found minus F from the truth, nats. If positive, the search failed; if negative,
            the posterior prefers another answer to the truth.
        terms: rise of each term of F.
        rivals: number of labellings that were averaged.
    """

    found: Tensor
    from_truth: Tensor
    rise: float
    terms: dict[str, float]
    rivals: int


@torch.no_grad()
def compare_with_truth(
    graph: ViewGraph,
    body_from_world: Tensor,
    is_wrong: Tensor,
    *,
    without: Collection[str] = (),
    weights: Path | None = None,
) -> Comparison:
    """Solve a robot's graph by its posterior, from its own starts and from the truth.

    Args:
        graph: N nodes, M edges.
        body_from_world: ``(N, 4)`` true orientations, all known.
        is_wrong: ``(M,)`` bool, false closures and odometry that slipped.
        without: those of :data:`rotavg_ros.solver.slam.options.SWITCHES` that are switched off.
        weights: folder of networks to use in place of the package's.
    """
    repeats = first_of_each(graph)
    if repeats is not None:
        first = torch.from_numpy(repeats[0])
        graph, is_wrong = graph.select_edges(first), is_wrong[first]
    network = None if "cleannet" in without else Networks("cpu", weights).load(SlamCleanNet)
    found = search(graph, network, slam_stages.bootstrap, without)
    problem, modes = found.drawn.problem, found.modes
    published = publish(problem, modes)

    truthful = from_truth(found.drawn, body_from_world, is_wrong)
    if problem.calibrated is not None:
        # The measurements may also be free of systematic errors.
        as_it_is = from_truth(Drawn.of(graph, network, without), body_from_world, is_wrong)
        truthful = min(truthful, as_it_is, key=lambda either: either.cost)
    truth = truthful.modes[0]
    terms = {name: nats - truth.evaluation.terms.get(name, 0.0) for name, nats in modes[0].evaluation.terms.items()}
    return Comparison(
        published.body_from_world,
        of_mode(truth).body_from_world,
        modes[0].cost - truth.cost,
        terms,
        len(published.rivals),
    )


@torch.no_grad()
def orientations_under(graph: ViewGraph, priors: SlamPriors, *, weights: Path | None = None) -> Tensor:
    """``(N, 4)`` body_from_world that the posterior publishes under given priors.

    Args:
        graph: N nodes.
        priors: all prior parameters.
        weights: folder of networks to use in place of the package's.
    """
    repeats = first_of_each(graph)
    graph = graph if repeats is None else graph.select_edges(torch.from_numpy(repeats[0]))
    found = search(graph, Networks("cpu", weights).load(SlamCleanNet), slam_stages.bootstrap, priors=priors)
    return publish(found.drawn.problem, found.modes).body_from_world


def from_truth(drawn: Drawn, body_from_world: Tensor, is_wrong: Tensor) -> Found:
    """Result of single flips and other noise from the true labels ``(M,)`` and orientations ``(N, 4)``."""
    problem, closure_graph = drawn.problem, drawn.prepared.closure_graph
    trusted = np.ones(len(closure_graph.source))
    trusted[closure_graph.num_segments :] = ~is_wrong.numpy()[closure_graph.view_graph_edge]
    slipped = closure_graph.segment_of_edge[is_wrong.numpy() & (closure_graph.segment_of_edge >= 0)]
    trusted[slipped] = 0.0
    begun = Search(problem)
    correction = closure_graph.corrections(body_from_world)
    start = at(problem, correction, trusted, initial_noise(drawn.prepared.noise))
    begun.keep(begun.flipped(begun.polished(start, "truth")))
    for mode in tuned(begun.modes[0]):
        begun.keep(mode)
    return Found(drawn, begun.modes)
