"""Measurements that a graph states more than once.

Exporters write an edge again for every message it came in, and senders repeat what may not have been received. Taken
for independent measurements, a repeated odometry edge seems free of noise, and copies of a false closure confirm each
other.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

# Largest difference of a measurement from its copy in the other direction, if a file gives six digits of both: products
# of the quaternion's components, and metres plus a share of the translation's length. Independent measurements differ
# by more.
_ROTATION, _SHIFT, _SHARE_OF_LENGTH = 1e-5, 5e-6, 1e-5
# Edges between the same nodes are sorted along this direction, in which different measurements hardly ever coincide.
_DIRECTION = np.sqrt(np.arange(2.0, 15.0))


def first_of_each(graph: ViewGraph) -> tuple[np.ndarray, np.ndarray] | None:
    """The edges that state something new, and for each edge the one of these that states the same.

    Two edges state the same if they have one kind, label and number of steps, connect the same nodes, and measure the
    same rotation and translation, up to rounding: exporters that write every edge both ways compute one from the other
    and give six digits of each. An edge without a translation differs from one with a translation.

    Returns:
        ``(U,)`` edges, ascending, and ``(M,)`` numbers in 0 … U − 1; None if no edge repeats another one.
    """
    source, target = graph.source.numpy(), graph.target.numpy()
    pair = np.minimum(source, target) * np.int64(graph.num_nodes) + np.maximum(source, target)
    in_order = np.sort(pair)
    several = in_order[1:][in_order[1:] == in_order[:-1]]
    if len(several) == 0:
        return None
    parallel = np.isin(pair, several).nonzero()[0]
    chosen = graph.select_edges(torch.from_numpy(parallel))
    forwards = (chosen.source < chosen.target)[:, None]
    rotation = torch.where(forwards, chosen.target_from_source, rotations.inverse(chosen.target_from_source)).numpy()
    row, column = np.triu_indices(4)
    rotation = rotation[:, row] * rotation[:, column]  # of q and -q the same
    shift = np.zeros((len(parallel), 3))
    has_shift: np.ndarray = np.zeros(len(parallel), dtype=bool)
    if chosen.translation is not None:
        turned = -rotations.rotate(chosen.target_from_source, chosen.translation)
        shift = torch.where(forwards, chosen.translation, turned).numpy()
        has_shift = np.asarray(~np.isnan(shift).any(axis=1))
        shift = np.where(has_shift[:, None], shift, 0.0)
    exact = (pair[parallel], chosen.kind.numpy(), chosen.label.numpy(), chosen.steps.numpy(), has_shift)
    order = np.lexsort((np.column_stack((rotation, shift)) @ _DIRECTION, *exact))
    reach = _SHIFT + _SHARE_OF_LENGTH * np.linalg.norm(shift, axis=1)[order[1:]]
    again = np.abs(np.diff(rotation[order], axis=0)).max(axis=1) <= _ROTATION
    again &= np.linalg.norm(np.diff(shift[order], axis=0), axis=1) <= reach
    for values in exact:
        again &= values[order[1:]] == values[order[:-1]]
    begins = np.flatnonzero(np.concatenate(([True], ~again)))
    first = np.minimum.reduceat(order, begins)
    says_as = np.arange(graph.num_edges)
    says_as[parallel[order]] = parallel[np.repeat(first, np.diff(begins, append=len(order)))]
    is_first = says_as == np.arange(graph.num_edges)
    if is_first.all():
        return None
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[says_as]


def without_repeats(graph: ViewGraph, first: np.ndarray, says_as: np.ndarray) -> ViewGraph:
    """The edges of :func:`first_of_each`, each with the highest precision that any of its copies states."""
    stated = graph.precision.nan_to_num(nan=0.0)
    highest = stated.new_zeros(len(first)).scatter_reduce(0, torch.from_numpy(says_as), stated, "amax")
    once = graph.select_edges(torch.from_numpy(first))
    return replace(once, precision=torch.where(highest > 0, highest, torch.nan))
