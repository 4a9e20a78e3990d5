"""Who is compared on pose graphs: the solver's methods, odometry alone, least squares, the peers and the oracle."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.baselines.start import spanning_forest
from rotavg_ros.datasets.simulation.false_closures import FALSE_CLOSURE_DEG
from rotavg_ros.evaluation.contenders import ContenderError
from rotavg_ros.evaluation.kept_answers import kept
from rotavg_ros.evaluation.least_squares import least_squares
from rotavg_ros.evaluation.metrics import true_edge_noise
from rotavg_ros.evaluation.named_peers import peer_solver
from rotavg_ros.evaluation.peers import PeerAnswer
from rotavg_ros.evaluation.slam_cases import SlamCase
from rotavg_ros.solver import METHODS, solve
from rotavg_ros.solver.spanning_tree import compose_orientations
from rotavg_ros.view_graph import ViewGraph

OURS = "neurora"
_OUTLIER_ANGLE = np.radians(FALSE_CLOSURE_DEG)


@dataclass(frozen=True)
class SlamAnswer:
    """What a contender made of a case (N nodes, M edges).

    Attributes:
        body_from_world: ``(N, 4)``; every component in a gauge of its own.
        is_outlier: ``(M,)`` bool, its verdicts; where it gives none, whether the residual exceeds 10°.
        cpu_seconds: CPU time from graph to answer, of all threads.
    """

    body_from_world: Tensor
    is_outlier: np.ndarray
    cpu_seconds: float


SlamContender = Callable[[SlamCase], "SlamAnswer | None"]


def _odometry(case: SlamCase) -> Tensor:
    return compose_orientations(spanning_forest(case.graph), case.graph)


def _least_squares(case: SlamCase) -> Tensor:
    return least_squares(case.graph, np.ones(case.graph.num_edges, dtype=bool))


def _oracle(case: SlamCase) -> Tensor:
    return least_squares(case.graph, case.is_inlier)


PEERS = ("gnc", "isam2", "colmap")
_REFERENCES: dict[str, Callable[[SlamCase], Tensor]] = {
    "odometry": _odometry,
    "least-squares": _least_squares,
    "oracle": _oracle,
}
ROWS: dict[str, str] = {
    OURS: "**ours** (NeuRoRA for SLAM)",
    "neurora-without-cleannet": "· without CleanNet",
    "neurora-odometry-start": "· without the weighted tree",
    "neurora-stated-precisions": "· without scale estimation",
    "neurora-without-slip-search": "· without the slip search",
    "cleannet-spt": "· without refinement",
    "spt": "· tree alone",
    "gnc": "GNC (GTSAM), told that odometry is right",
    "isam2": "iSAM2 with Huber's loss (GTSAM), incremental",
    "colmap": "COLMAP's rotation averaging",
    "chatterjee": "Chatterjee & Govindu (ℓ1 → ℓ½) from odometry",
    "least-squares": "least squares on all edges",
    "odometry": "odometry alone",
    "oracle": "oracle: least squares on the true inliers",
}


def contenders(names: Sequence[str], keep: Path | None = None) -> dict[str, SlamContender]:
    """Contenders by name: a method of the solver, a peer, "odometry", "least-squares" or "oracle".

    A contender returns None for a graph on which it gives up.

    Args:
        keep: folder of answers, to be found again by a later run.

    Raises:
        ContenderError: an unknown name.
        PeerError: a peer that is not installed.
    """
    return {name: _contender(name, keep) for name in names}


def _contender(name: str, keep: Path | None) -> SlamContender:
    if name in PEERS:
        return partial(_run_peer, peer_solver(name, keep))
    if name in _REFERENCES:
        run = partial(_run_reference, _REFERENCES[name])
    elif name in METHODS:
        run = partial(_run_method, name)
    else:
        choices = ", ".join((*METHODS, *PEERS, *_REFERENCES))
        raise ContenderError(f"unknown method {name!r}; choose from {choices}")
    return kept(name, run, SlamAnswer, keep, __name__)


def _run_method(name: str, case: SlamCase) -> SlamAnswer:
    start = time.process_time()
    solution = solve(case.graph, method=name, profile="slam")
    seconds = time.process_time() - start
    return SlamAnswer(solution.body_from_world, (solution.outlier_score > 0.5).numpy(), seconds)


def _run_peer(run: Callable[[ViewGraph], PeerAnswer | None], case: SlamCase) -> SlamAnswer | None:
    answer = run(case.graph)
    if answer is None:
        return None
    given = answer.is_outlier
    verdicts = _large_residual(case, answer.body_from_world) if given is None else given.numpy()
    return SlamAnswer(answer.body_from_world, verdicts, answer.cpu_seconds)


def _run_reference(run: Callable[[SlamCase], Tensor], case: SlamCase) -> SlamAnswer:
    start = time.process_time()
    orientations = run(case)
    seconds = time.process_time() - start
    return SlamAnswer(orientations, _large_residual(case, orientations), seconds)


def _large_residual(case: SlamCase, body_from_world: Tensor) -> np.ndarray:
    graph = case.graph
    residual = true_edge_noise(graph.target_from_source, graph.source, graph.target, body_from_world)
    return np.asarray(residual.numpy() > _OUTLIER_ANGLE)


def warm_up(chosen: Sequence[SlamContender]) -> None:
    """Let every contender pay its one-time costs (imports, weights, first kernels) on a short chain."""
    identity = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(4, 4)
    graph = ViewGraph.create([0, 1, 2, 0], [1, 2, 3, 3], identity, kind=[0, 0, 0, 1])
    case = SlamCase("warm-up", "clean", 0, graph, identity, 0.1, np.ones(4, dtype=bool), np.zeros(4))
    for contender in chosen:
        contender(case)
