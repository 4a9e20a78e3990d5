"""What was known of a view-graph's edges, carried over to the closure graph of a graph that has grown from it."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

_COLUMNS = ("source", "target", "target_from_source", "kind", "label", "steps")


def begins_with(graph: ViewGraph, earlier: ViewGraph, count: int | None = None) -> bool:
    """Whether ``graph`` begins with all edges of ``earlier``, or the first ``count``, and no other edge has a label."""
    count = earlier.num_edges if count is None else count
    if count > graph.num_edges or bool((graph.label[count:] != EdgeLabel.AUTOMATIC).any()):
        return False
    return all(torch.equal(getattr(graph, name)[:count], getattr(earlier, name)[:count]) for name in _COLUMNS)


def carried_over(value: np.ndarray, closure_graph: ClosureGraph, otherwise: float) -> np.ndarray:
    """Values ``(M,)`` of the earlier graph's edges → those of the closure graph ``(E,)``; for a segment, the minimum.

    Args:
        value: of the earlier graph's edges, which are the first of the graph.
        closure_graph: the contraction of the grown graph.
        otherwise: value of new edges.
    """
    of_edge = np.full(len(closure_graph.segment_of_edge), otherwise)
    of_edge[: len(value)] = value
    out = np.full(len(closure_graph.source), otherwise)
    on_segment = closure_graph.segment_of_edge >= 0
    np.minimum.at(out, closure_graph.segment_of_edge[on_segment], of_edge[on_segment])
    out[closure_graph.num_segments :] = of_edge[closure_graph.view_graph_edge]
    return out


def thinned_out(value: np.ndarray, earlier: ViewGraph, graph: ViewGraph, otherwise: float) -> np.ndarray | None:
    """Values ``(M,)`` of an earlier graph → ``(M',)`` of a graph that has lost keyframes and edges since.

    Closures are recognised by their measured rotation, bit by bit, since nodes are renumbered. Of several with the same
    rotation as many are known as there were, in their order; else those whose values agree. Odometry gets 1.

    Args:
        value: values of the earlier graph's edges.
        earlier, graph: the graphs.
        otherwise: value of new closures.

    Returns:
        The values; None if fewer than half of the closures are known, or if labels have changed.
    """
    old, new = (np.flatnonzero(~each.is_odometry.numpy()) for each in (earlier, graph))
    if len(old) == 0 or len(new) == 0:
        return None
    both = np.concatenate((_measured(earlier, old), _measured(graph, new)))
    was, now = np.split(np.unique(both, return_inverse=True)[1].ravel(), [len(old)])
    order, later = (np.argsort(each, kind="stable") for each in (was, now))
    rank = np.empty(len(now), dtype=np.int64)
    rank[later] = np.arange(len(now)) - np.searchsorted(now[later], now[later])
    counts = [np.bincount(each, minlength=len(both)) for each in (was, now)]
    are_all = (counts[0] == counts[1])[now]
    place = np.searchsorted(was, now, sorter=order) + np.where(are_all, rank, 0)
    match = order[np.minimum(place, len(was) - 1)]
    least, most = np.full(len(both), np.inf), np.full(len(both), -np.inf)
    np.minimum.at(least, was, value[old])
    np.maximum.at(most, was, value[old])
    is_known = (was[match] == now) & (are_all | (least == most)[now])
    label = np.where(is_known, earlier.label.numpy()[old[match]], EdgeLabel.AUTOMATIC)
    if 2 * is_known.sum() < len(new) or (label != graph.label.numpy()[new]).any():
        return None
    out = np.ones(graph.num_edges)
    out[new] = np.where(is_known, value[old[match]], otherwise)
    return out


def _measured(graph: ViewGraph, edges: np.ndarray) -> np.ndarray:
    """``(n,)`` bytes of the rotations that edges measure."""
    rows = np.ascontiguousarray(graph.target_from_source.numpy()[edges])
    return rows.view(f"V{rows.shape[1] * rows.itemsize}").ravel()
