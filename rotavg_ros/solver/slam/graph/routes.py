"""What odometry did along edges that several of its steps were drawn together into."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.odometry_route import Routes
from rotavg_ros.view_graph import ViewGraph


def routes_of(graph: ViewGraph, edge: np.ndarray, older: np.ndarray, displacement: np.ndarray) -> Routes:
    """As edges state it; of those that do not, steps are all alike.

    Args:
        graph: whose edges.
        edge: ``(n,)`` their numbers.
        older: ``(n,)`` the end of each where odometry came from. Routes are stated from the lower one.
        displacement: ``(n, 3)`` metres, to the newer end by the axes of the older one.
    """
    some = torch.from_numpy(edge)
    turn = torch.linalg.vector_norm(rotations.log(graph.target_from_source[some]), dim=1).double()
    even = Routes.even(turn.numpy(), displacement, graph.steps[some].numpy())
    if graph.route is None:
        return even
    is_lower = older == torch.minimum(graph.source[some], graph.target[some]).numpy()
    return Routes.known(np.where(is_lower[:, None], graph.route[some].numpy(), np.nan), even)
