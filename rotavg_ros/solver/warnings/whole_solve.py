"""Reasons not to trust the answer of a whole solve of a robot's graph."""

from __future__ import annotations

import math

from torch import Tensor

from rotavg_ros.solver.algebra.residuals import angles_after_alignment
from rotavg_ros.solver.warnings.conventions import mistaken_convention
from rotavg_ros.solver.warnings.flagged import FLAGGED
from rotavg_ros.solver.warnings.lone_places import lone_places
from rotavg_ros.solver.warnings.odometry import Odometry
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Number of believed closures up to which all may be false together, and the angle from odometry's answer, rad, that
# counts as far.
_FEW_BELIEVED, _FAR = 10, math.radians(30.0)


def of_whole_solve(graph: ViewGraph, body_from_world: Tensor, outlier_score: Tensor) -> tuple[str, ...]:
    """Further checks of a solve of a robot's graph from scratch.

    Args:
        graph: on the CPU, N nodes, M edges.
        body_from_world: ``(N, 4)`` the answer, in any gauge.
        outlier_score: ``(M,)``.
    """
    closures = ~graph.is_odometry & (graph.label != EdgeLabel.REJECTED)
    if not bool(graph.is_odometry.any()):
        return ()
    odometry = Odometry.of(graph)
    found = [mistaken_convention(odometry, graph.select_edges(closures.nonzero()[:, 0])), _gaps_of_places(graph)]
    believes = closures & (outlier_score <= FLAGGED)
    believed = int(believes.sum())
    if 0 < believed < _FEW_BELIEVED and bool((graph.components() == odometry.component).all()):
        found.append(_far_from_odometry(odometry, body_from_world, believed))
    found.append(lone_places(odometry, graph.select_edges(believes.nonzero()[:, 0])))
    return tuple(text for text in found if text is not None)


def _gaps_of_places(graph: ViewGraph) -> str | None:
    """Warns if translations of some odometry are unknown, so that none can be used."""
    if graph.translation is None:
        return None
    known, odometry = graph.translation.isfinite().all(dim=1), graph.is_odometry
    num_known, num_odometry = int((known & odometry).sum()), int(odometry.sum())
    if not 0 < num_known < num_odometry or not bool((known & ~odometry).any()):
        return None
    return (
        f"{num_odometry - num_known} of {num_odometry} odometry edges have no translation, so closures are judged by "
        "their rotations alone, and one that joins wrong places may be believed; the odometry of every robot must "
        "state its position throughout"
    )


def _far_from_odometry(odometry: Odometry, body_from_world: Tensor, believed: int) -> str | None:
    component = odometry.component
    apart = angles_after_alignment(odometry.orientation, body_from_world, component, int(component.max()) + 1)
    angle = float(apart.mean())
    if angle <= _FAR:
        return None
    count = "1 believed loop closure turns" if believed == 1 else f"{believed} believed loop closures turn"
    return (
        f"{count} the orientations away from odometry's by {math.degrees(angle):.0f}° on average; so few closures may "
        "all be false: look at them, label those that are wrong, or compare with odometry alone"
    )
