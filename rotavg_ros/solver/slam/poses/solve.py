"""Poses of a robot's graph after its rotations were solved, by the passes or by the search of the posterior."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.passes.alternation import Verdicts
from rotavg_ros.solver.slam.poses.answer import Poses, answer, rival_poses
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.starts import at, noise_of
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.solve import Found
from rotavg_ros.solver.slam.preparation import Prepared
from rotavg_ros.solver.slam.stages import CleanedClosures
from rotavg_ros.view_graph import ViewGraph

_FALSE = 0.5


def has_places(graph: ViewGraph) -> bool:
    """Whether translations of all odometry are known, of some closures, and lead anywhere."""
    if graph.translation is None:
        return False
    known = graph.translation.isfinite().all(dim=1)
    odometry = graph.is_odometry
    moves = bool(graph.translation[odometry].any())
    return moves and bool(known[odometry].all()) and bool(known[~odometry].any())


def poses_after_passes(graph: ViewGraph, prepared: Prepared, cleaned: CleanedClosures, verdicts: Verdicts) -> Poses:
    """With the labels and the noise that the passes ended with, which rivals are not looked for.

    Args:
        graph: N nodes, M edges, with translations.
        prepared: the same, drawn together.
        cleaned: what CleanNet says of its closures.
        verdicts: the passes' answer.
    """
    return answer(rival_poses(graph, _translations(graph), [mode_of_passes(prepared, cleaned, verdicts)]))


def mode_of_passes(prepared: Prepared, cleaned: CleanedClosures, verdicts: Verdicts) -> Mode:
    """Labels and noise of the passes' answer, as the posterior sees them."""
    problem = Problem.of(prepared, cleaned.network_log_odds)
    trusted = (verdicts.outlier_probability < _FALSE).astype(np.float64)
    state = at(problem, verdicts.correction, trusted, noise_of(problem, verdicts.noise))
    return Mode(problem, *polish(problem, state, hold_noise=True), "passes")


def poses_after_search(graph: ViewGraph, found: Found) -> Poses:
    """Of the labellings that the search has found, the likeliest by both."""
    return answer(rival_poses(graph, _translations(graph), found.modes))


def _translations(graph: ViewGraph) -> np.ndarray:
    assert graph.translation is not None
    return np.asarray(graph.translation.numpy())
