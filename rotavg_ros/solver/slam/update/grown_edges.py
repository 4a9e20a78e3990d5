"""What was known of a view-graph's edges, carried over to the closure graph of a graph that has grown from it."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

_COLUMNS = ("source", "target", "target_from_source", "kind", "label", "steps")


def begins_with(graph: ViewGraph, earlier: ViewGraph) -> bool:
    """Whether all edges of ``earlier`` come first in ``graph``, as they were, and of the others none has a label."""
    count = earlier.num_edges
    if count > graph.num_edges or bool((graph.label[count:] != EdgeLabel.AUTOMATIC).any()):
        return False
    return all(torch.equal(getattr(graph, name)[:count], getattr(earlier, name)) for name in _COLUMNS)


def carried_over(value: np.ndarray, closure_graph: ClosureGraph, otherwise: float) -> np.ndarray:
    """Values ``(M,)`` of the earlier graph's edges → those of the closure graph ``(E,)``; a segment's least.

    Args:
        otherwise: of edges that are new.
    """
    of_edge = np.full(len(closure_graph.segment_of_edge), otherwise)
    of_edge[: len(value)] = value
    out = np.full(len(closure_graph.source), otherwise)
    on_segment = closure_graph.segment_of_edge >= 0
    np.minimum.at(out, closure_graph.segment_of_edge[on_segment], of_edge[on_segment])
    out[closure_graph.num_segments :] = of_edge[closure_graph.view_graph_edge]
    return out
