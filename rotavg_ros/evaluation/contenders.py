"""Who is compared: the solver's methods and combinations, COLMAP, Shonan, and an oracle that knows the outliers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import torch
from torch import Tensor

from rotavg_ros.datasets.synthetic import SFM_OUTLIER_ANGLE
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.kept_answers import kept
from rotavg_ros.evaluation.metrics import true_edge_noise
from rotavg_ros.evaluation.named_peers import peer_solver
from rotavg_ros.evaluation.peers import PeerAnswer
from rotavg_ros.solver import METHODS, sfm_refinement, solve
from rotavg_ros.solver.refinement import refine
from rotavg_ros.solver.sfm_stages import residual_score
from rotavg_ros.solver.spanning_tree import shortest_path_forest
from rotavg_ros.view_graph import ViewGraph

FULL_PIPELINE = "neurora"
# Until it moves no more: a few steps would remember the truth that they start from.
_ORACLE_STEPS = 50
_PEERS = ("colmap", "shonan")
# Shonan's matrices beyond this many edges take minutes.
_MAX_EDGES = {"shonan": 150_000}
_ORACLES = ("oracle", "oracle-shaped")


class ContenderError(UserError):
    """An unknown contender; the message lists the choices."""


@dataclass(frozen=True)
class Case:
    """A view-graph to be solved and what is known of it (N nodes, M edges).

    Attributes:
        truth: body_from_world ``(N, 4)``; NaN rows where unknown.
    """

    name: str
    graph: ViewGraph
    truth: Tensor

    @property
    def noise_angle(self) -> Tensor:
        """``(M,)`` rad, true noise of every edge; NaN where unknown."""
        return true_edge_noise(self.graph.target_from_source, self.graph.source, self.graph.target, self.truth)


@dataclass(frozen=True)
class Answer:
    """What a contender made of a case.

    Attributes:
        body_from_world: ``(N, 4)``; every component in a gauge of its own.
        outlier_score: ``(M,)`` probability that the edge's noise exceeds 20°.
        cpu_seconds: CPU time from graph to answer, of all threads.
    """

    body_from_world: Tensor
    outlier_score: Tensor
    cpu_seconds: float


Contender = Callable[[Case], "Answer | None"]


def contenders(names: Sequence[str], weights: Path | None = None, keep: Path | None = None) -> dict[str, Contender]:
    """Contenders by name: a method of the solver, several joined by "+", "colmap", "shonan" or "oracle".

    A contender returns None for a case that is too large for it or on which it gives up.

    Args:
        weights: folder of networks to use in place of the package's.
        keep: folder of answers, but for those of such networks, to be found again by a later run.

    Raises:
        ContenderError: an unknown name.
        PeerError: a peer that is not installed.
    """
    return {name: _contender(name, weights, keep) for name in names}


def _contender(name: str, weights: Path | None, keep: Path | None) -> Contender:
    if name in _PEERS:
        return _peer(peer_solver(name, keep), _MAX_EDGES.get(name))
    if name in _ORACLES:
        return kept(name, partial(_oracle, name == "oracle-shaped"), Answer, keep, __name__)
    unknown = [part for part in name.split("+") if part not in METHODS]
    if unknown:
        choices = ", ".join((*METHODS, *_PEERS, *_ORACLES))
        raise ContenderError(f"unknown method {unknown[0]!r}; choose from {choices}, or combine: A+B")
    # Networks of a folder are those of one run, and nobody asks for their answers again.
    return kept(name, partial(_solve, name, weights), Answer, None if weights else keep, __name__)


def _solve(name: str, weights: Path | None, case: Case) -> Answer:
    start = time.process_time()
    solution = solve(case.graph, method=name, profile="sfm", weights=weights)
    return Answer(solution.body_from_world, solution.outlier_score, time.process_time() - start)


def _peer(run: Callable[[ViewGraph], PeerAnswer | None], max_edges: int | None) -> Contender:
    def solve_case(case: Case) -> Answer | None:
        if max_edges is not None and case.graph.num_edges > max_edges:
            return None
        answer = run(case.graph)
        if answer is None:
            return None
        return Answer(answer.body_from_world, _residual_score(case, answer.body_from_world), answer.cpu_seconds)

    return solve_case


def _oracle(is_shaped: bool, case: Case) -> Answer:
    """Our refinement from the truth to convergence, every true inlier weighing one and every outlier nothing."""
    start = time.process_time()
    is_inlier = (case.noise_angle <= SFM_OUTLIER_ANGLE).double()
    if is_shaped:
        weights = sfm_refinement.EdgeWeights(is_inlier, is_inlier)
        orientations = sfm_refinement.refine(case.graph, case.truth, _ORACLE_STEPS, weights=weights)
    else:
        roots = shortest_path_forest(case.graph).roots
        orientations = refine(case.graph, case.truth, is_inlier, roots, _ORACLE_STEPS)
    seconds = time.process_time() - start
    return Answer(orientations, _residual_score(case, orientations), seconds)


def _residual_score(case: Case, body_from_world: Tensor) -> Tensor:
    return residual_score(case.graph, body_from_world, SFM_OUTLIER_ANGLE)


def warm_up(chosen: Sequence[Contender]) -> None:
    """Let every contender pay its one-time costs (imports, weights, first kernels) on a triangle."""
    identity = torch.tensor([[0.0, 0.0, 0.0, 1.0]], dtype=torch.float64).expand(3, 4)
    triangle = ViewGraph.create([0, 1, 2], [1, 2, 0], identity)
    for contender in chosen:
        contender(Case("warm-up", triangle, identity))
