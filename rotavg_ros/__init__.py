"""Online SLAM rotation averaging: ``solve`` a :class:`ViewGraph` for absolute orientations and outlier scores."""

from rotavg_ros.errors import UserError
from rotavg_ros.solver import METHODS, Solution, solve
from rotavg_ros.version import __version__
from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph, ViewGraphError

__all__ = [
    "METHODS", "EdgeKind", "EdgeLabel", "Solution", "UserError", "ViewGraph", "ViewGraphError", "__version__", "solve",
]
