"""Measurements that a graph states more than once.

Exporters write an edge again for every message it came in, and a sender repeats what it is not sure was heard. Taken
for independent, an odometry edge that is there twice seems free of noise, and copies of a false closure confirm each
other.
"""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.view_graph import ViewGraph

# Decimals to which the quaternions of one measurement agree, in whichever direction it is written.
_DECIMALS = 9


def first_of_each(graph: ViewGraph) -> tuple[np.ndarray, np.ndarray] | None:
    """The edges that say something new, and which of these says the same as each edge.

    Two edges say the same if they are of one kind and label, between the same nodes, and measure the same
    rotation and translation.
    Independent measurements of a pair of nodes differ, be it by little. One without a translation differs from one
    with.

    Returns:
        ``(U,)`` edges, ascending, and ``(M,)`` numbers in 0 … U-1; None if there are no repetitions.
    """
    source, target = graph.source.numpy(), graph.target.numpy()
    pair = np.minimum(source, target) * np.int64(graph.num_nodes) + np.maximum(source, target)
    in_order = np.sort(pair)
    parallel = np.isin(pair, in_order[1:][in_order[1:] == in_order[:-1]]).nonzero()[0]
    if len(parallel) == 0:
        return None
    chosen = graph.select_edges(torch.from_numpy(parallel))
    forwards = (chosen.source < chosen.target)[:, None]
    measured = torch.where(forwards, chosen.target_from_source, rotations.inverse(chosen.target_from_source))
    said = np.column_stack((pair[parallel], chosen.kind, chosen.label, chosen.steps, measured.numpy().round(_DECIMALS)))
    if chosen.translation is not None:
        turned = -rotations.rotate(chosen.target_from_source, chosen.translation)
        shift = torch.where(forwards, chosen.translation, turned)
        said = np.column_stack((said, shift.nan_to_num().numpy().round(_DECIMALS)))
    _, first, number = np.unique(said, axis=0, return_index=True, return_inverse=True)
    says_as = np.arange(graph.num_edges)
    says_as[parallel] = parallel[first[number.reshape(-1)]]
    is_first = says_as == np.arange(graph.num_edges)
    if is_first.all():
        return None
    return np.flatnonzero(is_first), (np.cumsum(is_first) - 1)[says_as]
