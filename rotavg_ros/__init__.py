"""Online SLAM rotation averaging: ``solve`` a :class:`ViewGraph` for absolute orientations and outlier scores."""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

from rotavg_ros.errors import UserError
from rotavg_ros.version import __version__

if TYPE_CHECKING:
    from rotavg_ros.solver import METHODS, Solution, solve, solve_batch
    from rotavg_ros.view_graph import EdgeKind, EdgeLabel, ViewGraph, ViewGraphError

__all__ = [
    "METHODS",
    "EdgeKind",
    "EdgeLabel",
    "Solution",
    "UserError",
    "ViewGraph",
    "ViewGraphError",
    "__version__",
    "solve",
    "solve_batch",
]

# Imported on first use, so that `rotavg --help` and mistakes on the command line need not wait for torch.
_MODULE_OF_NAME = {
    **dict.fromkeys(("METHODS", "Solution", "solve", "solve_batch"), "rotavg_ros.solver"),
    **dict.fromkeys(("EdgeKind", "EdgeLabel", "ViewGraph", "ViewGraphError"), "rotavg_ros.view_graph"),
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)
