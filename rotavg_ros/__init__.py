"""Rotation averaging with outlier rejection: absolute orientations and edge scores from relative rotations.

- :func:`solve` a :class:`ViewGraph`, or the content of a file that :func:`read_graph` reads, for a :class:`Solution`.
- :class:`OnlineEstimator`: odometry and :class:`EdgeMeasurement` in, ticks, an :class:`Answer` out; no ROS needed.
- Mistakes in what is given raise :class:`UserError` with one line that says what is wrong.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rotavg_ros.errors import UserError
from rotavg_ros.version import __version__

if TYPE_CHECKING:
    from rotavg_ros.datasets.graph_file import GraphFile, read_graph, write_graph
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

# Imported on first use, so that `rotavg --help` and mistakes on the command line need not wait for torch.
_MODULE_OF_NAME = {
    **dict.fromkeys(("METHODS", "Solution", "solve", "solve_batch"), "rotavg_ros.solver"),
    **dict.fromkeys(("EdgeKind", "EdgeLabel", "ViewGraph", "ViewGraphError"), "rotavg_ros.view_graph"),
    **dict.fromkeys(("GraphFile", "read_graph", "write_graph"), "rotavg_ros.datasets.graph_file"),
    **dict.fromkeys(("Answer", "EdgeMeasurement", "EstimatorOptions"), "rotavg_ros.online"),
    **dict.fromkeys(("KeyframeReference", "OnlineEstimator", "RejectReason"), "rotavg_ros.online"),
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
