"""Nodes that no odometry reaches, but many closures to keyframes near each other do: submaps.

Cartographer's pose graph has a node for each submap, and a constraint to each keyframe that it was built of. Such a
node hangs on odometry at one of these keyframes; what the others say is then a closure over few steps.
"""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths, odometry_forest, runs_along
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Nodes hang on odometry if so many closures lead to keyframes near each other, and those of all such nodes are as many
# as other closures, and at least so many.
_LEAST, _LEAST_IN_ALL = 3, 100
_ROUNDING = 1e-12


def hung(graph: ViewGraph, *, some_do: bool = False) -> np.ndarray:
    """``(n,)`` the closure of each such node by which it hangs on odometry: amid those that agree.

    Args:
        graph: N nodes, M edges.
        some_do: whether other nodes are known to hang, so that few more are enough.
    """
    none = np.zeros(0, dtype=np.int64)
    is_closure = ~graph.is_odometry & (graph.label != EdgeLabel.REJECTED)
    ends = torch.stack((graph.source, graph.target)).numpy()
    touched = np.bincount(ends[:, graph.is_odometry.numpy()].ravel(), minlength=graph.num_nodes) > 0
    edge = np.flatnonzero(is_closure.numpy() & (touched[ends].sum(axis=0) == 1))
    if len(edge) < (_LEAST if some_do else _LEAST_IN_ALL):
        return none
    paths = OdometryPaths.along(graph, odometry_forest(graph))
    is_target = touched[ends[1, edge]]
    keyframe, node = np.where(is_target, ends[::-1][:, edge], ends[:, edge])
    run = runs_along(node, paths.chain[keyframe], paths.position[keyframe])
    size = np.bincount(run)[run]
    # The largest run of each node.
    order = np.lexsort((run, -size, node))
    first = order[np.unique(node[order], return_index=True)[1]]
    chosen = np.isin(run, run[first][size[first] >= _LEAST])
    if not chosen.any() or not (some_do or chosen.sum() >= max(_LEAST_IN_ALL, int(is_closure.sum()) - chosen.sum())):
        return none
    edge, keyframe, run = edge[chosen], keyframe[chosen], np.unique(run[chosen], return_inverse=True)[1]
    stated = graph.target_from_source[edge]
    to_node = torch.where(torch.from_numpy(is_target[chosen])[:, None], rotations.inverse(stated), stated)
    implied = rotations.multiply(to_node, paths.orientation[keyframe]).numpy()
    moment = np.zeros((run.max() + 1, 4, 4))
    np.add.at(moment, run, implied[:, :, None] * implied[:, None])
    mean = np.linalg.eigh(moment)[1][:, :, -1]
    off = 1 - np.abs((implied * mean[run]).sum(axis=1))
    # Of those as near to the mean as most, the one in the middle of the run.
    near = off <= 4 * _median(off, run)[run] + _ROUNDING
    at = paths.position[keyframe]
    first, last = np.full(run.max() + 1, np.inf), np.full(run.max() + 1, -np.inf)
    np.minimum.at(first, run, at)
    np.maximum.at(last, run, at)
    off_middle = np.abs(2 * at - (first + last)[run])
    order = np.lexsort((edge, off_middle, ~near, run))
    return np.asarray(edge[order[np.unique(run[order], return_index=True)[1]]])


def _median(value: np.ndarray, run: np.ndarray) -> np.ndarray:
    """``(R,)`` a value of each of R runs that half of its values ``(n,)`` do not exceed."""
    order = np.lexsort((value, run))
    begin = np.searchsorted(run[order], np.arange(run.max() + 1))
    size = np.bincount(run)
    return np.asarray(value[order][begin + (size - 1) // 2])
