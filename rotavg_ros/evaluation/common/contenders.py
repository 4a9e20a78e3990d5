"""The contenders: the solver's methods and combinations, the peers, and references with extra knowledge."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

from torch import Tensor

from rotavg_ros.baselines import residual_score
from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.answers import Answer, Clock
from rotavg_ros.evaluation.common.cases import Case, Family, warm_up_case
from rotavg_ros.evaluation.common.kept_answers import KeptAnswers
from rotavg_ros.evaluation.common.named_peers import is_available, is_installed, missing, peer_solver
from rotavg_ros.solver import METHODS, solve
from rotavg_ros.solver.methods import is_method, unknown_method
from rotavg_ros.view_graph import ViewGraph

# None: the case is too large for it, or it gives up.
Contender = Callable[[Case], Answer | None]
Reference = Callable[[Case], Tensor | None]


class ContenderError(UserError):
    """An unknown contender; the message lists the choices."""


@dataclass(frozen=True)
class OwnContender:
    """A contender that is told more about a case than its graph; it judges edges itself.

    Attributes:
        solve: case → answer; None if it gives up.
        package: the package on PyPI that does the work; None: ours.
    """

    solve: Contender
    package: str | None = None


@dataclass(frozen=True)
class Roster:
    """The contenders that may take part in a suite besides the solver's methods.

    Attributes:
        family: of the suite's cases.
        peers: of :data:`rotavg_ros.evaluation.common.named_peers.PEERS`.
        references: case → body_from_world ``(N, 4)``, None if the case does not tell what it has to know; by name.
        max_edges: number of edges of the largest graph that a contender is given, by name.
        own: contenders only of this suite, by name.
    """

    family: Family
    peers: tuple[str, ...]
    references: Mapping[str, Reference]
    max_edges: Mapping[str, int] = field(default_factory=dict)
    own: Mapping[str, OwnContender] = field(default_factory=dict)

    def is_peer(self, name: str) -> bool:
        """Whether another package does the work."""
        return name in self.peers or (name in self.own and self.own[name].package is not None)

    def can_run(self, name: str) -> bool:
        """Whether what a contender needs is installed."""
        own = self.own.get(name)
        return is_available(name) if own is None else own.package is None or is_installed(own.package)


def contenders(
    names: Sequence[str], roster: Roster, weights: Path | None = None, keep: KeptAnswers | None = None
) -> dict[str, Contender]:
    """Contenders by name: a method of the solver, several joined by "+", or one of the roster.

    A contender returns None for a case that is too large for it or on which it gives up. Those that do not judge edges
    get scores by their residuals.

    Args:
        weights: folder of networks to use instead of the package's.
        keep: stores answers, except those of such networks, for a later run.

    Raises:
        ContenderError: an unknown name.
        PeerError: a peer that is not installed.
    """
    return {name: _contender(name, roster, weights, keep) for name in names}


def warm_up(chosen: Collection[Contender], roster: Roster, case: Case | None = None) -> None:
    """Let every contender pay its one-time costs on a tiny graph.

    Args:
        case: default: only rotations, without noise.
    """
    case = warm_up_case(roster.family) if case is None else case
    for contender in chosen:
        contender(case)


def _contender(name: str, roster: Roster, weights: Path | None, keep: KeptAnswers | None) -> Contender:
    if name in roster.peers:
        return partial(_run_peer, peer_solver(name, keep), roster.max_edges.get(name))
    if name in roster.references:
        reference = roster.references[name]
        run: Contender = partial(_run_reference, reference)
        return run if keep is None else keep.keeping(run, name, (__name__, reference.__module__))
    if name in roster.own:
        return _own(name, roster, keep)
    unknown = [part for part in name.split("+") if not is_method(part)]
    if unknown:
        others = (*roster.peers, *roster.references, *roster.own)
        raise ContenderError(unknown_method(unknown[0], (*METHODS, *others)))
    run = partial(_run_method, name, weights)
    # Networks of a folder belong to one run, so their answers are not needed again.
    return run if keep is None or weights is not None else keep.keeping(run, name, (__name__,))


def _own(name: str, roster: Roster, keep: KeptAnswers | None) -> Contender:
    own = roster.own[name]
    if own.package is not None and not is_installed(own.package):
        raise missing(name, own.package)
    module = inspect.getmodule(own.solve.func if isinstance(own.solve, partial) else own.solve)
    assert module is not None
    run = own.solve if keep is None else keep.keeping(own.solve, name, (__name__, module.__name__), own.package)
    limit = roster.max_edges.get(name)

    def within_limit(case: Case) -> Answer | None:
        return None if limit is not None and case.graph.num_edges > limit else run(case)

    return within_limit


def _run_method(name: str, weights: Path | None, case: Case) -> Answer:
    clock = Clock()
    with clock.running():
        solution = solve(case.graph, method=name, profile=case.family.profile, weights=weights)
    # Where positions are unknown, an edge is judged by its rotation alone.
    of_rotation = case.poses is None and solution.rotation_score is not None
    return Answer(
        solution.body_from_world,
        clock.seconds,
        clock.cpu_seconds,
        solution.rotation_score if of_rotation else solution.outlier_score,
        solution.uncertainty,
        solution.position,
    )


def _run_reference(reference: Reference, case: Case) -> Answer | None:
    clock = Clock()
    with clock.running():
        orientations = reference(case)
    if orientations is None:
        return None
    return _judged(Answer(orientations, clock.seconds, clock.cpu_seconds), case)


def _run_peer(solver: Callable[[ViewGraph], Answer | None], max_edges: int | None, case: Case) -> Answer | None:
    if max_edges is not None and case.graph.num_edges > max_edges:
        return None
    answer = solver(case.graph)
    return None if answer is None else _judged(answer, case)


def _judged(answer: Answer, case: Case) -> Answer:
    """The answer with scores: its own, or those from residuals."""
    if answer.outlier_score is not None:
        return answer
    score = residual_score(case.graph, answer.body_from_world, case.family.outlier_angle)
    return replace(answer, outlier_score=score)
