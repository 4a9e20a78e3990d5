"""A robot's graph by its posterior: starts, moves, and the average over the labellings that are left."""

from __future__ import annotations

from collections.abc import Collection

from torch import Tensor

from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.modes import Published, publish
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.solver.slam.stages import CleanedClosures


def solve_posterior(
    prepared: Prepared, cleaned: CleanedClosures, correction: Tensor, without: Collection[str] = ()
) -> Published:
    """What is published of a prepared graph.

    Args:
        prepared: the graph drawn together.
        cleaned: what CleanNet says of its closures.
        correction: ``(K, 4)`` of the tree, or of an earlier answer to begin with.
        without: terms and moves that are switched off.
    """
    problem = problem_of(prepared, cleaned, without)
    return publish(problem, Search(problem).run(prepared, cleaned, correction))


def problem_of(prepared: Prepared, cleaned: CleanedClosures, without: Collection[str] = ()) -> Problem:
    """The posterior's view of a prepared graph."""
    graph, components = prepared.closure_graph, prepared.noise.components
    return Problem.of(graph, prepared.pairs, components, cleaned.network_log_odds, without=without)
