"""NeuRoRA and its relatives: ``solve`` a :class:`~rotavg_ros.view_graph.ViewGraph`, or ``solve_batch`` of many.

What is named here is imported when it is first used: the methods' names cost no torch.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rotavg_ros.solver.batch import solve_batch
    from rotavg_ros.solver.methods import DEVICES, METHODS, PROFILES, TRANSLATION_SCALES
    from rotavg_ros.solver.pipeline import advance, solve
    from rotavg_ros.solver.running.kept_labels import KeptLabels
    from rotavg_ros.solver.running.work import SECONDS_PER_UNIT, Abandoned, abandonable, stop_if_abandoned
    from rotavg_ros.solver.solution import Solution

__all__ = [
    "DEVICES",
    "METHODS",
    "PROFILES",
    "SECONDS_PER_UNIT",
    "TRANSLATION_SCALES",
    "Abandoned",
    "KeptLabels",
    "Solution",
    "abandonable",
    "advance",
    "solve",
    "solve_batch",
    "stop_if_abandoned",
]


def __getattr__(name: str) -> Any:
    if name in {"DEVICES", "METHODS", "PROFILES", "TRANSLATION_SCALES"}:
        from rotavg_ros.solver import methods

        return getattr(methods, name)
    if name in {"SECONDS_PER_UNIT", "Abandoned", "abandonable", "stop_if_abandoned"}:
        from rotavg_ros.solver.running import work

        return getattr(work, name)
    if name == "KeptLabels":
        from rotavg_ros.solver.running import kept_labels

        return kept_labels.KeptLabels
    if name == "Solution":
        from rotavg_ros.solver import solution

        return getattr(solution, name)
    if name in __all__:  # how to solve
        from rotavg_ros.solver import batch, pipeline

        return {"advance": pipeline.advance, "solve": pipeline.solve, "solve_batch": batch.solve_batch}[name]
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
