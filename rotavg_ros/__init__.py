"""Rotation averaging with outlier rejection: absolute orientations and edge scores from relative rotations.

- :func:`solve` a :class:`ViewGraph`, or the content of a file that :func:`read_graph` reads, for a :class:`Solution`.
- :class:`OnlineEstimator`: odometry and :class:`EdgeMeasurement` in, ticks, an :class:`Answer` out; no ROS needed.
- Mistakes in the input raise :class:`UserError` with one line that says what is wrong.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from rotavg_ros.errors import UserError
from rotavg_ros.version import __version__

if TYPE_CHECKING:
    from rotavg_ros.datasets.files.formats import read_graph, write_graph
    from rotavg_ros.datasets.files.graph_file import GraphFile
    from rotavg_ros.online import (
        Answer,
        EdgeMeasurement,
        EstimatorOptions,
        KeyframeReference,
        OnlineEstimator,
        RejectReason,
    )
    from rotavg_ros.solver import METHODS, Solution, solve, solve_batch
    from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph, ViewGraphError

__all__ = [
    "METHODS",
    "Answer",
    "EdgeKind",
    "EdgeLabel",
    "EdgeMeasurement",
    "EstimatorOptions",
    "GraphFile",
    "KeyframeReference",
    "OnlineEstimator",
    "RejectReason",
    "Solution",
    "UserError",
    "ViewGraph",
    "ViewGraphError",
    "__version__",
    "read_graph",
    "solve",
    "solve_batch",
    "write_graph",
]


def __getattr__(name: str) -> Any:
    # Imported on first use, so that `rotavg --help` and mistakes on the command line need not wait for torch.
    if name in {"METHODS", "Solution", "solve", "solve_batch"}:
        from rotavg_ros import solver

        return getattr(solver, name)
    if name in {"EdgeKind", "EdgeLabel", "ViewGraph", "ViewGraphError"}:
        from rotavg_ros import view_graph

        return getattr(view_graph, name)
    if name in {"GraphFile", "read_graph", "write_graph"}:
        from rotavg_ros.datasets.files import formats

        return getattr(formats, name)
    if name in __all__:
        from rotavg_ros import online

        return getattr(online, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
