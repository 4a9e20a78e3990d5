"""A solve that costs nothing: it loads the networks, and refuses options that the solver does not know."""

from __future__ import annotations

from rotavg_ros import ViewGraph, solve
from rotavg_ros.online import EstimatorOptions
from rotavg_ros.view_graph import EdgeKind


def warm_up(options: EstimatorOptions) -> str:
    """Solve a triangle; returns the device.

    Raises:
        UserError: from the solver.
    """
    triangle = ViewGraph.create(
        [0, 1, 0], [1, 2, 2], [[0.0, 0.0, 0.0, 1.0]] * 3, kind=[EdgeKind.ODOMETRY] * 2 + [EdgeKind.LOOP_CLOSURE]
    )
    return solve(
        triangle,
        method=options.method,
        profile=options.profile,
        device=options.device,
        refinement_steps=options.max_refinement_steps,
    ).device
