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
# Metres that nothing is squared with: odometry of such a step tells no places.
_ABSURD = 1e100


def has_places(graph: ViewGraph) -> bool:
    """Whether translations of all odometry are known, of some closures, and lead anywhere."""
    if graph.translation is None:
        return False
    known = (graph.translation.abs() < _ABSURD).all(dim=1)
    odometry = graph.is_odometry
    moves = bool(graph.translation[odometry].any())
    return moves and bool(known[odometry].all()) and bool(known[~odometry].any())


def poses_of(graph: ViewGraph, mode: Mode, memory: PoseMemory | None = None) -> PoseMemory:
    """With the labels of the rotations as they are.

    Args:
        graph: N nodes, M edges, with translations.
        mode: the labels, and the same graph drawn together.
        memory: where to begin; default: from nothing.
    """
    return _going_on(graph, mode, memory) or likeliest_poses(graph, [mode])[0]


def mode_of_passes(prepared: Prepared, network_log_odds: np.ndarray, verdicts: Verdicts) -> Mode:
    """Labels and noise of the passes' answer, as the posterior sees them."""
    problem = Problem.of(prepared, network_log_odds)
    trusted = (verdicts.outlier_probability < _FALSE).astype(np.float64)
    state = at(problem, verdicts.correction, trusted, noise_of(problem, verdicts.noise))
    return Mode(problem, *polish(problem, state, hold_noise=True), "passes")


def likeliest_poses(graph: ViewGraph, modes: list[Mode]) -> tuple[PoseMemory, Mode]:
    """Poses, and the labelling of ``modes`` that rotations and translations together make likeliest.

    Args:
        graph: without its bias, with translations.
        modes: labellings of its rotations.
    """
    rivals = rival_poses(graph, _translations(graph), modes)
    likeliest = rivals[0][0]
    return PoseMemory.of(likeliest, answer(rivals)), likeliest.problem.mode


def poses_of_update(graph: ViewGraph, mode: Mode, memory: PoseMemory) -> PoseMemory | None:
    """Of a graph without its bias that has grown, with the labels of its rotations; None if all is due."""
    return _going_on(graph, mode, memory)


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
