"""Where edges lead, and what odometry did along those that several of its steps were drawn together into."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.odometry_route import Routes
from rotavg_ros.view_graph import ViewGraph


def routes_of(graph: ViewGraph, edge: np.ndarray, older: np.ndarray) -> Routes:
    """As edges state it; of those that do not, steps are all alike.

    Args:
        graph: whose edges.
        edge: ``(n,)`` their numbers.
        older: ``(n,)`` the end of each where odometry came from. Routes are stated from the lower one.
    """
    some = torch.from_numpy(edge)
    displacement = np.zeros((len(edge), 3))
    if graph.translation is not None:
        onwards = np.where(graph.source.numpy()[edge] == older, 1.0, -1.0)[:, None]
        displacement = onwards * ways_by(graph, edge, graph.translation[some].double().numpy(), older)
    turn = torch.linalg.vector_norm(rotations.log(graph.target_from_source[some]), dim=1).double()
    even = Routes.even(turn.numpy(), displacement, graph.steps[some].numpy())
    stated = graph.select_edges(some).of_routes(slice(None))
    if stated is None:
        return even
    is_lower = older == torch.minimum(graph.source[some], graph.target[some]).numpy()
    return Routes.known(np.where(is_lower[:, None], stated.numpy(), np.nan), even)


def ways_by(graph: ViewGraph, edge: np.ndarray, translation: np.ndarray, at: np.ndarray) -> np.ndarray:
    """``(n, 3)`` metres from source to target of edges ``(n,)``, by the axes of one of their ends.

    Args:
        graph: whose edges.
        edge: ``(n,)`` their numbers.
        translation: ``(n, 3)`` metres, as they are stated.
        at: ``(n,)`` that end.
    """
    turned = rotations.rotate(graph.target_from_source[edge].double(), torch.from_numpy(translation)).numpy()
    return np.where((graph.source.numpy()[edge] == at)[:, None], translation, turned)


def turned_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` rad², sums of the squares of the steps' turns; NaN where unknown."""
    return _column(graph, 0)


def way_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` metres, along the steps; NaN where unknown."""
    return _column(graph, 1)


def _column(graph: ViewGraph, number: int) -> np.ndarray | None:
    column = graph.of_routes(number)
    return None if column is None else np.asarray(column.numpy())
