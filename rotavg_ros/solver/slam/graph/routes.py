"""Displacements of edges, and the routes of odometry edges that several steps were merged into."""

from __future__ import annotations

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.odometry_route import Routes
from rotavg_ros.view_graph import ViewGraph


def routes_of(graph: ViewGraph, edge: np.ndarray, older: np.ndarray) -> Routes:
    """Routes of odometry edges as stated; edges that state none get one with equal steps.

    Args:
        graph: the graph.
        edge: ``(n,)`` edges.
        older: ``(n,)`` the older end of each. Routes are stated from the end with the lower number, so they are used
            only where that is the older one.
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
    """``(n, 3)`` metres from source to target of edges ``(n,)``, in the axes of one of their ends.

    Args:
        graph: the graph.
        edge: ``(n,)`` edges.
        translation: ``(n, 3)`` metres, in the source's axes.
        at: ``(n,)`` the end whose axes are used.
    """
    turned = rotations.rotate(graph.target_from_source[edge].double(), torch.from_numpy(translation)).numpy()
    return np.where((graph.source.numpy()[edge] == at)[:, None], translation, turned)


def turned_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` rad², sum of the squared turns of each edge's steps; NaN where unknown. None if no edge states it."""
    return _column(graph, 0)


def way_along(graph: ViewGraph) -> np.ndarray | None:
    """``(M,)`` metres, length of each edge along its steps; NaN where unknown. None if no edge states it."""
    return _column(graph, 1)


def _column(graph: ViewGraph, number: int) -> np.ndarray | None:
    column = graph.of_routes(number)
    return None if column is None else np.asarray(column.numpy())
