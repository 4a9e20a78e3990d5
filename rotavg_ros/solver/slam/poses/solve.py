"""Poses of a robot's graph after its rotations were solved, by the passes or by the search of the posterior."""

from __future__ import annotations

import numpy as np

from rotavg_ros.solver.slam.passes.alternation import Verdicts
from rotavg_ros.solver.slam.poses.answer import answer, rival_poses
from rotavg_ros.solver.slam.poses.estimate import estimate_poses
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.poses.rows import PoseProblem
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.moves.starts import at, noise_of
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.preparation import Prepared
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


def poses_after_passes(
    graph: ViewGraph,
    prepared: Prepared,
    network_log_odds: np.ndarray,
    verdicts: Verdicts,
    memory: PoseMemory | None = None,
) -> PoseMemory:
    """With the labels and the noise that the passes ended with, which rivals are not looked for.

    Args:
        graph: N nodes, M edges, with translations.
        prepared: the same, drawn together into E edges.
        network_log_odds: ``(E,)`` what CleanNet says of its closures.
        verdicts: the passes' answer.
        memory: where to begin; default: from nothing.
    """
    mode = mode_of_passes(prepared, network_log_odds, verdicts)
    return _going_on(graph, mode, memory) or _from_nothing(graph, [mode])


def mode_of_passes(prepared: Prepared, network_log_odds: np.ndarray, verdicts: Verdicts) -> Mode:
    """Labels and noise of the passes' answer, as the posterior sees them."""
    problem = Problem.of(prepared, network_log_odds)
    trusted = (verdicts.outlier_probability < _FALSE).astype(np.float64)
    state = at(problem, verdicts.correction, trusted, noise_of(problem, verdicts.noise))
    return Mode(problem, *polish(problem, state, hold_noise=True), "passes")


def poses_after_search(graph: ViewGraph, modes: list[Mode]) -> PoseMemory:
    """Of the labellings that the search has found, the likeliest by both."""
    return _from_nothing(graph, modes)


def poses_of_update(graph: ViewGraph, mode: Mode, memory: PoseMemory) -> PoseMemory | None:
    """Of a graph without its bias that has grown, with the labels of its rotations; None if all is due."""
    return _going_on(graph, mode, memory)


def _from_nothing(graph: ViewGraph, modes: list[Mode]) -> PoseMemory:
    rivals = rival_poses(graph, _translations(graph), modes)
    return PoseMemory.of(rivals[0][0], answer(rivals))


def _going_on(graph: ViewGraph, mode: Mode, memory: PoseMemory | None) -> PoseMemory | None:
    problem = PoseProblem(graph, _translations(graph), mode)
    start = None if memory is None else memory.start(graph, problem)
    if start is None:
        return None
    pose = estimate_poses(problem, start=start)
    return PoseMemory.of(pose, answer([(pose, 1.0)]), memory)


def _translations(graph: ViewGraph) -> np.ndarray:
    assert graph.translation is not None
    return np.asarray(graph.translation.numpy())
