"""How far steps of odometry turn, which is not told by their own noise."""

from __future__ import annotations

import numpy as np
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest, accumulate_to_root
from rotavg_ros.view_graph import ViewGraph


def squared_turns(graph: ViewGraph, forest: SpanningForest, step_variance: float) -> np.ndarray:
    """``(N,)`` rad², squares of odometry's turns from each node's root on.

    What is measured of a step's turn has its noise in it, and the steps that err by most would seem to be those that
    turn by most. So a step counts as its neighbours turn, but for the probability that it turns by something else:
    that its turn is any up to half a turn, not theirs with the noise of all, with even odds beforehand.

    Args:
        graph: N nodes.
        forest: along its odometry.
        step_variance: rad² per component, of the noise of a step.
    """
    is_step = forest.parent_edge >= 0
    is_step[is_step] = graph.is_odometry.numpy()[forest.parent_edge[is_step]]
    square = np.zeros(len(is_step))
    square[is_step] = (rotations.log(graph.target_from_source) ** 2).sum(dim=1).numpy()[forest.parent_edge[is_step]]
    # By the nodes that steps lead to, away from the root.
    step = np.flatnonzero(is_step)
    step = step[is_step[forest.parent[step]]]
    before = forest.parent[step]
    total, count = np.zeros_like(square), np.zeros_like(square)
    total[step], count[step] = square[before], 1.0
    np.add.at(total, before, square[step])
    np.add.at(count, before, 1.0)
    beside = np.divide(total, count, out=square.copy(), where=count > 0)
    variance = step_variance * (1 + 1 / np.maximum(count, 1.0))
    off = np.sqrt(square) - np.sqrt(beside)
    log_alike = -(off**2) / (2 * variance) - np.log(2 * np.pi * variance) / 2
    own = expit(-np.log(np.pi) - log_alike)
    return accumulate_to_root(forest, own * square + (1 - own) * beside)
