"""How far steps of odometry turn, estimated without their own noise."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest, accumulate_to_root
from rotavg_ros.solver.slam.graph.routes import turned_along
from rotavg_ros.view_graph import ViewGraph


def squared_turns(graph: ViewGraph, forest: SpanningForest, step_variance: float) -> np.ndarray:
    """``(N,)`` rad², sums of the squared turns of odometry's steps from each node's root on.

    A step's measured turn includes its noise, so the steps that err most would seem to turn most. Therefore a step
    counts with the mean square of its neighbours, but for the probability that it turns otherwise. The two hypotheses
    have even prior odds: its turn is that of the neighbours with the noise of all, or any up to half a turn. All steps
    of an edge that several were merged into count alike.

    Args:
        graph: N nodes.
        forest: along its odometry.
        step_variance: rad² per component, of the noise of a step.
    """
    is_step = forest.parent_edge >= 0
    is_step[is_step] = graph.is_odometry.numpy()[forest.parent_edge[is_step]]
    edge = forest.parent_edge[is_step]
    steps, square = np.zeros(len(is_step)), np.zeros(len(is_step))
    steps[is_step] = graph.steps.numpy()[edge]
    square[is_step] = _of_edges(graph)[edge] / steps[is_step]
    # Sums over the steps at both ends of each, wherever the root is.
    total, count = square.copy(), is_step.astype(np.float64)
    np.add.at(total, forest.parent[is_step], square[is_step])
    np.add.at(count, forest.parent[is_step], 1.0)
    total = np.maximum(total[forest.parent] + total - 2 * square, 0.0)
    count = np.where(is_step, count[forest.parent] + count - 2, 0.0)
    beside = np.divide(total, count, out=square.copy(), where=count > 0)
    variance = step_variance * (1 + 1 / np.maximum(count, 1.0))
    off = np.sqrt(square) - np.sqrt(beside)
    log_alike = -(off**2) / (2 * variance) - np.log(2 * np.pi * variance) / 2
    own = expit(-np.log(np.pi) - log_alike)
    return accumulate_to_root(forest, steps * (own * square + (1 - own) * beside))


def _of_edges(graph: ViewGraph) -> np.ndarray:
    """``(M,)`` rad², sums over the steps that each edge stands for; if they are unknown, as if all turned alike."""
    even = ((rotations.log(graph.target_from_source) ** 2).sum(dim=1) / graph.steps).numpy()
    known = turned_along(graph)
    return np.asarray(even if known is None else np.where(np.isnan(known), even, known))
