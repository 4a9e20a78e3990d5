"""What training sees of a robot's graph: its closures as CleanNet of the SLAM profile gets them."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.network import ClosureFeatures, SlamCleanNet, closure_features
from rotavg_ros.solver.slam.preparation import prepare
from rotavg_ros.view_graph import ViewGraph

__all__ = ["ClosureFeatures", "SlamCleanNet", "closure_inputs"]


def closure_inputs(graph: ViewGraph) -> tuple[ClosureFeatures, np.ndarray] | None:
    """The network's input for all C closures of a graph on the CPU, and which edges of it they are ``(C,)``.

    Returns:
        None where there are fewer than two closures.
    """
    prepared = prepare(graph)
    closure_graph = prepared.closure_graph
    closures = closure_graph.view_graph_edge[closure_graph.is_closure[prepared.num_segments :]]
    if len(closures) < 2:
        return None
    return closure_features(prepared.noise, prepared.squared_angle, prepared.path_steps, prepared.pairs), closures
