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
    stated = graph.select_edges(some).of_routes(slice(None))
    if stated is None:
        return even
    is_lower = older == torch.minimum(graph.source[some], graph.target[some]).numpy()
    return Routes.known(np.where(is_lower[:, None], stated.numpy(), np.nan), even)


def turned_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` rad², sums of the squares of the steps' turns; NaN where unknown."""
    return _column(graph, 0)


def way_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` metres, along the steps; NaN where unknown."""
    return _column(graph, 1)


def _column(graph: ViewGraph, number: int) -> np.ndarray | None:
    column = graph.of_routes(number)
    return None if column is None else np.asarray(column.numpy())
