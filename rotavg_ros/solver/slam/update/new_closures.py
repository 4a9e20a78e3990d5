"""Closures that have just come, judged by the closures around them."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import KDTree
from scipy.special import expit

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.agreement import NUM_NEIGHBOURS, agreement_pairs, closure_ends
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.common_error import RUN_GAP_STEPS
from rotavg_ros.solver.slam.noise.model import NoiseModel
from rotavg_ros.solver.slam.stages import judge_closures


class NewClosures(NamedTuple):
    """Of n closures ``(n,)`` each: probability of being good, network's log-odds of it, inflation for common errors."""

    inlier_probability: np.ndarray
    network_log_odds: np.ndarray
    variance_factor: np.ndarray


def judge_new_closures(
    network: SlamCleanNet | None,
    noise: NoiseModel,
    graph: ClosureGraph,
    closure: np.ndarray,
    new: np.ndarray,
    variance_factor: np.ndarray,
) -> NewClosures:
    """By their discrepancies with the odometry and, with a network, by the few hundred closures around them.

    Args:
        noise: as the odometry has it.
        closure: ``(C,)`` the graph's closures, ascending.
        new: ``(n,)`` of these, the new ones.
        variance_factor: ``(E,)`` of the others, see :func:`~rotavg_ros.solver.slam.noise.common_error.variance_factor`.
    """
    is_new = np.isin(closure, new, assume_unique=True)
    ends = closure_ends(graph, closure)
    tree = KDTree(ends, balanced_tree=False, compact_nodes=False)
    distance, neighbour = tree.query(ends[is_new], k=NUM_NEIGHBOURS + 1, p=1)
    # Where closures err together, the new one errs as that next to it.
    is_near = ~is_new[neighbour] & (distance <= RUN_GAP_STEPS)
    nearest = np.take_along_axis(neighbour, is_near.argmax(axis=1)[:, None], axis=1)[:, 0]
    # Messages run from neighbour to neighbour; what is farther than two rounds away hardly counts.
    around = np.unique(neighbour)
    around = np.union1d(around, tree.query(ends[around], k=NUM_NEIGHBOURS + 1, p=1)[1])
    chosen = closure[around]
    squared_angle = (rotations.log(graph.residual[torch.from_numpy(chosen)]) ** 2).sum(dim=1).numpy()
    log_odds, of_network = judge_closures(
        network, noise, squared_angle, graph.path_steps[chosen], agreement_pairs(graph, chosen)
    )
    judged = is_new[around]
    return NewClosures(
        expit(log_odds[judged]),
        of_network[judged],
        np.where(is_near.any(axis=1), variance_factor[closure[nearest]], 1.0),
    )
