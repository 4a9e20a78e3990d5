"""NeuRoRA and its relatives: ``solve`` a :class:`~rotavg_ros.view_graph.ViewGraph`, or ``solve_batch`` of many.

What is named here is imported when it is first used: the methods' names cost no torch.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rotavg_ros.solver.batch import solve_batch
    from rotavg_ros.solver.methods import DEVICES, METHODS, PROFILES
    from rotavg_ros.solver.pipeline import solve
    from rotavg_ros.solver.solution import Solution

__all__ = ["DEVICES", "METHODS", "PROFILES", "Solution", "solve", "solve_batch"]

_MODULE_OF_NAME = {
    **dict.fromkeys(("DEVICES", "METHODS", "PROFILES"), "rotavg_ros.solver.methods"),
    "Solution": "rotavg_ros.solver.solution",
    "solve": "rotavg_ros.solver.pipeline",
    "solve_batch": "rotavg_ros.solver.batch",
}


def __getattr__(name: str) -> Any:
    if name not in _MODULE_OF_NAME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(importlib.import_module(_MODULE_OF_NAME[name]), name)


def __dir__() -> list[str]:
    return sorted(__all__)
