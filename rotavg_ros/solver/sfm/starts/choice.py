"""The refinement from several starts, and the best of the solutions that these lead to.

Coarse steps begin at each start, and end early where they come near a solution that is known. Where several solutions
cost nearly the same, a few shaped steps are taken from each; where even then another one costs hardly more than the
best, both are refined to the end, and an answer that is hardly likelier than its rival is called doubtful.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import EdgeResiduals, angles_after_alignment
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.solver.sfm.refinement import PRIORS, EdgeWeights, coarse_steps, settle, shaped_steps
from rotavg_ros.solver.sfm.starts.parts import Parts
from rotavg_ros.solver.sfm.step.problem import Problem
from rotavg_ros.solver.sfm.step.structure import Structure
from rotavg_ros.view_graph import ViewGraph


class Start(NamedTuple):
    """Where a refinement may begin.

    Attributes:
        body_from_world: ``(N, 4)``.
        coarse: ``(M,)`` positive factors of the robust weights in coarse steps from there.
        among: ``(C,)`` bool, components that may begin there; None: all.
        is_settled: coarse steps on a subset of the edges led there; more are taken only if the start differs from the
            best one and is not much worse.
    """

    body_from_world: Tensor
    coarse: Tensor
    among: Tensor | None = None
    is_settled: bool = False


class Begun(NamedTuple):
    """Where coarse steps have led.

    Attributes:
        body_from_world: ``(N, 4)``.
        coarse: ``(M,)`` the weights that these steps used.
        steps: ``(C,)`` number of steps.
        rival: another solution in some components, whose cost is too close to decide by; None: nowhere.
        parts: parts of the graph that few edges join; None: it was not searched for any.
    """

    body_from_world: Tensor
    coarse: Tensor
    steps: Tensor
    rival: Begun | None = None
    parts: Parts | None = None


def begin(
    graph: ViewGraph, starts: Sequence[Start], shaped: Tensor, structure: Structure, priors: RefinementPriors = PRIORS
) -> Begun:
    """Coarse steps from several starts; each component keeps the one with clearly the lowest Σ w ‖r‖^½ afterwards.

    That is the cost of the shaped steps, a few of which are taken to tell starts apart. A likelihood would not do: its
    scale tends to zero where an answer fits as many edges exactly as there are nodes.

    Args:
        shaped: ``(M,)`` positive factors of the robust weights in shaped steps.
    """
    problem = Problem(graph, structure, priors)
    shaped = shaped.float().clamp(min=priors.least_prior)
    first = _Found.after(problem, starts[0], shaped)
    search = _Search(problem, shaped, [first], first)
    for start in starts[1:]:
        search.add(start)
    for _ in range(priors.starts.rounds if len(starts) > 1 else 0):
        has_gained = [search.add(start) for start in search.turned()]
        if not any(has_gained):
            break
    return search.chosen()


@dataclass
class _Search:
    """Where starts have led so far, and the best of it; weights ``(M,)`` of the cost."""

    problem: Problem
    shaped: Tensor
    found: list[_Found]
    best: _Found
    parts: Parts | None = None

    def add(self, start: Start) -> bool:
        """Coarse steps from a start; returns whether it is the best so far, in some component."""
        problem, priors, best = self.problem, self.problem.priors, self.best
        known = best.begun.body_from_world
        may_begin = torch.ones_like(best.cost, dtype=torch.bool) if start.among is None else start.among
        if start.is_settled:
            may_begin = may_begin & (_share_apart(problem, known, start.body_from_world) > priors.rival_share)
            cost = problem.cost(start.body_from_world, self.shaped)
            may_begin = may_begin & (cost < (1 + priors.hopeless) * best.cost)
            if not bool(may_begin.any()):
                return False
        one = _Found.after(problem, start, self.shaped, known)
        may_begin = may_begin & (_share_apart(problem, known, one.begun.body_from_world) > 0)
        one = one._replace(cost=torch.where(may_begin, one.cost, torch.inf))
        is_better = one.cost < best.cost
        self.found.append(one)
        self.best = best.but(problem, is_better, one)
        return bool(is_better.any())

    def turned(self) -> list[Start]:
        """Starts in which parts of the best solution are turned."""
        problem, priors, known = self.problem, self.problem.priors, self.best.begun.body_from_world
        if problem.graph.num_edges > priors.starts.most_searched:
            return []
        angle = EdgeResiduals(problem.graph, known.float()).angles()
        self.parts = parts = Parts.of(problem.graph, angle, self.shaped, priors)
        at = np.ascontiguousarray(known.cpu().numpy().T)
        better = parts.improved(at, priors)
        rival = parts.rival(at if better is None else better, priors)
        turned = (torch.from_numpy(np.ascontiguousarray(one.T)) for one in (better, rival) if one is not None)
        return [Start(one.to(known), self.shaped) for one in turned]

    def chosen(self) -> Begun:
        """The best solution after further steps from those near it, and its rival."""
        problem, priors = self.problem, self.problem.priors
        # Further steps tell solutions apart in components where at least two are near the least cost.
        is_near = [one.cost < (1 + priors.hopeless) * self.best.cost for one in self.found]
        is_contested = torch.stack(is_near).sum(dim=0) > 1
        found = [
            one.told(problem, is_contested & near, self.shaped) for one, near in zip(self.found, is_near, strict=True)
        ]
        best = found[0]
        for one in found[1:]:
            is_better = one.cost < (1 - priors.same_valley) * best.cost
            is_hardly = ~is_better & (one.cost < best.cost)
            if bool(is_hardly.any()):
                apart = _share_apart(problem, best.begun.body_from_world, one.begun.body_from_world)
                is_better = is_better | (is_hardly & (apart > priors.rival_share))
            best = best.but(problem, is_better, one)
        return best.begun._replace(rival=_rival(problem, found, best), parts=self.parts)


class _Found(NamedTuple):
    """Where a start has led, and its cost ``(C,)``; infinite in components where it is out of the question."""

    begun: Begun
    cost: Tensor

    @classmethod
    def after(cls, problem: Problem, start: Start, shaped: Tensor, known: Tensor | None = None) -> _Found:
        """After coarse steps from ``start``, or as many as lead to the ``known`` solution ``(N, 4)``."""
        is_over = None if known is None else lambda at: _share_apart(problem, known, at) == 0
        orientations, steps = coarse_steps(problem, start.body_from_world, start.coarse, is_over)
        return cls.at(problem, Begun(orientations, start.coarse, steps), orientations, shaped)

    @classmethod
    def at(cls, problem: Problem, begun: Begun, orientations: Tensor, shaped: Tensor) -> _Found:
        """At orientations ``(N, 4)`` to which further steps have led."""
        return cls(begun._replace(body_from_world=orientations), problem.cost(orientations, shaped))

    def told(self, problem: Problem, chosen: Tensor, shaped: Tensor) -> _Found:
        """After a few shaped steps in the chosen components ``(C,)``."""
        if not bool(chosen.any()):
            return self
        priors, begun = problem.priors, self.begun
        few = (priors.max_steps - begun.steps).clamp(max=priors.telling_steps)
        further = shaped_steps(problem, begun.body_from_world, EdgeWeights(shaped, shaped), few).orientations
        return self.but(problem, chosen, _Found.at(problem, begun, further, shaped))

    def but(self, problem: Problem, chosen: Tensor, other: _Found) -> _Found:
        """The same but for the chosen components ``(C,)``, which are those of ``other``."""
        if not bool(chosen.any()):
            return self
        return _Found(_where(problem, chosen, other.begun, self.begun), torch.where(chosen, other.cost, self.cost))


def _rival(problem: Problem, found: Sequence[_Found], best: _Found) -> Begun | None:
    """In each component, the solution of least cost that is another one than ``best`` and hardly costs more."""
    priors = problem.priors
    rival = best._replace(cost=(1 + priors.rival_cost) * best.cost)
    is_any = torch.zeros_like(problem.roots, dtype=torch.bool)
    for one in found:
        is_rival = one.cost < rival.cost
        if bool(is_rival.any()):
            apart = _share_apart(problem, best.begun.body_from_world, one.begun.body_from_world)
            is_rival = is_rival & (apart > priors.rival_share)
            rival, is_any = rival.but(problem, is_rival, one), is_any | is_rival
    return rival.begun if bool(is_any.any()) else None


def _where(problem: Problem, chosen: Tensor, one: Begun, other: Begun) -> Begun:
    """``one`` in the chosen components ``(C,)``, ``other`` elsewhere."""
    of_node = chosen[problem.component]
    orientations = torch.where(of_node[:, None], one.body_from_world, other.body_from_world)
    coarse = torch.where(of_node[problem.graph.source], one.coarse, other.coarse)
    return Begun(orientations, coarse, torch.where(chosen, one.steps, other.steps))


def _share_apart(problem: Problem, one: Tensor, other: Tensor) -> Tensor:
    """``(C,)`` share of each component's nodes whose orientations in two solutions ``(N, 4)`` are far apart."""
    return problem.mean(
        (angles_after_alignment(one, other, problem.component, len(problem.roots)) > NUMBERS.outlier_angle).double()
    )


class Best(NamedTuple):
    """Result of :func:`settle_best`.

    Attributes:
        body_from_world: ``(N, 4)``.
        weights: those of the coarse steps that led there.
        is_doubtful: ``(N,)`` bool, nodes that another solution, under which the edges are nearly as likely, turns far;
            None: there is no such solution.
    """

    body_from_world: Tensor
    weights: EdgeWeights
    is_doubtful: Tensor | None = None


def settle_best(
    graph: ViewGraph, begun: Begun, weights: EdgeWeights, structure: Structure, priors: RefinementPriors = PRIORS
) -> Best:
    """:func:`settle` from ``begun`` and from its rival; each component keeps the result of lower cost.

    Likelihoods decide no better: of 50 tuning graphs with a rival the two disagreed on 10, and the cost was right about
    6, among them the two with the largest differences. But where the edges are hardly likelier under the answer, or
    less so, it is doubtful.
    """
    weights = weights._replace(coarse=begun.coarse)

    def settled(one: Begun) -> _Found:
        refined = settle(graph, one.body_from_world, weights, structure, priors, one.steps)
        return _Found(one._replace(body_from_world=refined.body_from_world), refined.cost)

    own = settled(begun)
    if begun.rival is None:
        return Best(own.begun.body_from_world, weights)
    problem, shaped, others = Problem(graph, structure, priors), weights.shaped.float(), settled(begun.rival)
    is_better = others.cost < own.cost
    best, worse = own.but(problem, is_better, others).begun, others.but(problem, is_better, own).begun
    ahead = problem.log_likelihood(best.body_from_world, shaped) - problem.log_likelihood(worse.body_from_world, shaped)
    angle = angles_after_alignment(best.body_from_world, worse.body_from_world, problem.component, len(problem.roots))
    is_doubtful = (angle > NUMBERS.outlier_angle) & (ahead < priors.rival_nats)[problem.component]
    weights = weights._replace(coarse=best.coarse)
    return Best(best.body_from_world, weights, is_doubtful if bool(is_doubtful.any()) else None)
