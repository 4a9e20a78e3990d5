"""A robot's graph by its posterior: starts and moves, with what all measurements have wrong alike or without it."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.solver.algebra.odometry_lengths import ways_passed
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.routes import way_along
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.calibration import PARTS, Calibration, calibrated
from rotavg_ros.solver.slam.noise.mounting import ALIKE, between_axes, estimate_mountings, is_about_as_said, may_be_told
from rotavg_ros.solver.slam.noise.turns import squared_turns
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.preparation import Prepared, likely_bias, prepare_as_it_is
from rotavg_ros.solver.slam.stages import CleanedClosures, clean
from rotavg_ros.view_graph import ViewGraph

# A part of the calibration is made better so many times at most, as long as F falls by more than this, nats.
_ROUNDS, _LEAST_GAIN = 8, 0.5
# A mounting that makes all likelier by so many nats is worth a word.
_SUSPICIOUS = 5.0
# Units of work for each edge of what a problem is told beforehand.
_EDGE = 0.002


@dataclass(frozen=True)
class Drawn:
    """A graph drawn together, and its problem.

    Attributes:
        prepared: without what all measurements have wrong alike, if anything.
        cleaned: what CleanNet says of its closures.
        problem: the posterior's view of it.
    """

    prepared: Prepared
    cleaned: CleanedClosures
    problem: Problem

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        network: SlamCleanNet | None,
        without: Collection[str] = (),
        calibration: Calibration | None = None,
        priors: SlamPriors | None = None,
        components: int | None = None,
    ) -> Drawn:
        """After what all have wrong alike is taken out of the measurements, if that is anything.

        Components: k, if it is to be another than that of the rotations that are left.
        """
        corrected = calibrated(graph, calibration)
        prepared = prepare_as_it_is(corrected, components)
        cleaned = clean(network, prepared, graph.label)
        spend(_EDGE * graph.num_edges)
        taken_out = None
        if calibration is not None:
            taken_out = Calibrated.of(corrected, prepared, calibration, calibration.parts)
        turned = squared_turns(corrected, prepared.forest, prepared.noise.step_variance)
        problem = Problem.of(
            prepared, cleaned.network_log_odds, priors=priors, without=without, calibrated=taken_out, turned=turned
        )
        problem = replace(problem, travelled=_travelled(graph, prepared))
        return cls(prepared, cleaned, problem)

    def orientations(self, state: State) -> Tensor:
        """``(N, 4)`` body_from_world."""
        return self.problem.drawn(state.noise).orientations(torch.from_numpy(np.ascontiguousarray(state.correction.T)))


@dataclass(frozen=True)
class Found:
    """What the search found, the least F first.

    Attributes:
        drawn: without what was taken out of all measurements of a kind, if anything was.
        modes: of it.
        suspected: ``(3,)`` rad, by which closures and odometry seem to have other axes, if either may be why.
    """

    drawn: Drawn
    modes: list[Mode]
    suspected: np.ndarray | None = None

    @property
    def cost(self) -> float:
        """F of the best mode, nats."""
        return self.modes[0].cost

    @property
    def calibration(self) -> Calibration | None:
        """What was taken out of all measurements of a kind, if anything was."""
        taken_out = self.drawn.problem.calibrated
        return None if taken_out is None else taken_out.calibration

    @property
    def mounting(self) -> np.ndarray:
        """``(3,)`` rad that was taken out of closures."""
        return np.zeros(3) if self.calibration is None else self.calibration.mounting

    @property
    def is_mounted_nearby(self) -> bool:
        """Whether what was taken out of closures may as well be odometry's fault."""
        near = np.radians(self.drawn.problem.priors.closure_deg)
        return bool(self.mounting.any()) and is_about_as_said(self.mounting, near)


Begin = Callable[[Prepared, CleanedClosures], Tensor]


def search(
    graph: ViewGraph,
    network: SlamCleanNet | None,
    begin: Begin,
    without: Collection[str] = (),
    priors: SlamPriors | None = None,
) -> Found:
    """The labellings of least F of a graph that states nothing twice.

    Args:
        graph: N nodes.
        network: CleanNet, or None without it.
        begin: corrections ``(K, 4)`` to begin with: along CleanNet's tree, or of an earlier answer.
        without: terms and moves that are switched off.
        priors: other ones than usual.
    """
    solver = _Solver(graph, network, begin, without, priors)
    as_said = solver.from_starts(None)
    likely = {part: solver.likely(as_said, part) for part in PARTS if part not in without}
    found, suspected = solver.with_parts(as_said, likely), None
    if found.is_mounted_nearby:
        # It may as well be odometry's fault.
        mounted = found
        found = solver.with_parts(as_said, {part: each for part, each in likely.items() if part != "mounting"})
        if mounted.cost < found.cost - _SUSPICIOUS and np.linalg.norm(mounted.mounting) > ALIKE:
            suspected = mounted.mounting
    left = calibrated(graph, found.calibration)
    if left.rotation_components < graph.rotation_components:
        # What is left turns about one axis, and so it errs.
        found = solver.from_starts(found.calibration, left.rotation_components)
    return replace(found, suspected=suspected)


class _Predicted(NamedTuple):
    """By how many nats F changes with another calibration, as far as a Newton step tells."""

    cost: float
    calibration: Calibration


class _Solver(NamedTuple):
    """What :func:`search` is given."""

    graph: ViewGraph
    network: SlamCleanNet | None
    begin: Begin
    without: Collection[str]
    priors: SlamPriors | None

    def from_starts(self, calibration: Calibration | None, components: int | None = None) -> Found:
        """What is found from all starts after a calibration is taken out; k is the graph's, if nothing else is said."""
        drawn = self._drawn(calibration, components)
        begun = Search(drawn.problem)
        begun.run(drawn.prepared, drawn.cleaned, self.begin(drawn.prepared, drawn.cleaned))
        return Found(drawn, begun.modes)

    def likely(self, found: Found, part: str) -> list[Found]:
        """What is found from all starts with one more part of the calibration, which closures beside odometry tell."""
        before = found.calibration or Calibration.none()
        values = _likely(part, before.taken_out_of(self.graph), found.drawn.prepared)
        return [self.from_starts(replace(before, **{part: value})) for value in values]

    def with_parts(self, as_said: Found, likely: dict[str, list[Found]]) -> Found:
        """What is found with some parts of the calibration or without them, from what is likely of each on."""
        if not likely:
            return as_said
        begun = min([as_said, *(each for of_part in likely.values() for each in of_part)], key=attrgetter("cost"))
        found = self.one_by_one(begun, likely)
        if begun is not as_said and found.calibration is not None and found.calibration.parts == set(likely):
            # What one part explains, another may, too.
            found = min(found, self.one_by_one(as_said, likely), key=attrgetter("cost"))
        return found

    def one_by_one(self, found: Found, parts: Collection[str]) -> Found:
        """What is found by Newton's steps on more and more parts, the one that promises more first."""
        ordered = sorted(parts, key=lambda part: (self.predicted(found, part).cost, part))
        for part in ordered:
            found = self.with_part(found, part)
        if found.calibration is not None and ordered[0] not in found.calibration.parts:
            found = self.with_part(found, ordered[0])
        return found

    def with_part(self, found: Found, part: str) -> Found:
        """What is found with one more part of the calibration by Newton's steps.

        Closures that another part was taken out of may speak of this one otherwise than before.
        """
        if found.calibration is not None and part not in found.calibration.parts:
            found = min([found, *self.likely(found, part)], key=attrgetter("cost"))
        for _ in range(_ROUNDS):
            better = self._better(found, part)
            if better is None:
                break
            found = better
        return found

    def predicted(self, found: Found, part: str) -> _Predicted:
        """Newton's step from the best mode, on what is calibrated and one part more."""
        best, before = found.modes[0], found.calibration or Calibration.none()
        problem, evaluation = best.problem, best.evaluation
        prepared, parts = found.drawn.prepared, {part, *before.parts}
        tried = Calibrated.of(before.taken_out_of(self.graph), prepared, before, parts)
        information, change = tried.information(
            problem.graph.source, best.state, evaluation.residual, evaluation.factorised, problem.priors
        )
        cost = tried.cost(information, problem.priors) - evaluation.terms.get("calibration", 0.0)
        return _Predicted(cost - float(change @ information @ change) / 2, before.moved(change @ tried.axes))

    def _better(self, found: Found, part: str) -> Found | None:
        """What is found from the best mode after that step, if F falls."""
        cost, calibration = self.predicted(found, part)
        if cost > -_LEAST_GAIN or (part == "mounting" and np.linalg.norm(calibration.mounting) < ALIKE):
            return None
        best, drawn = found.modes[0], found.drawn
        again = self._drawn(calibration)
        goes_on = Search(again.problem)
        goes_on.keep(goes_on.flipped(goes_on.polished(_moved(best, drawn, again), "calibration")))
        goes_on.move_on()
        better = Found(again, goes_on.modes)
        return better if better.cost < found.cost - _LEAST_GAIN else None

    def _drawn(self, calibration: Calibration | None, components: int | None = None) -> Drawn:
        """F is compared with what is found without, so that k stays whatever C leaves."""
        k = components or self.graph.rotation_components
        return Drawn.of(self.graph, self.network, self.without, calibration, self.priors, k)


def _likely(part: str, graph: ViewGraph, prepared: Prepared) -> list[np.ndarray]:
    """``(3,)`` each, what closures beside odometry make of a part that nothing was taken out of yet."""
    if part == "mounting":
        # Where all that is measured turns about one axis, an upside-down sensor is what inverted closures look like.
        if prepared.noise.components == 1 or not may_be_told(graph):
            return []
        return between_axes(graph) or estimate_mountings(graph, prepared.closure_graph, prepared.noise)
    bias = likely_bias(graph, prepared)
    return [] if bias is None else [bias]


def _travelled(graph: ViewGraph, prepared: Prepared) -> np.ndarray | None:
    """``(N,)`` metres of odometry from each node's root on; None unless all of it is known."""
    if graph.translation is None:
        return None
    length = torch.from_numpy(ways_passed(graph.translation.double().numpy(), way_along(graph)))
    if not bool(torch.isfinite(length[graph.is_odometry]).all()):
        return None
    return _from_root(torch.where(graph.is_odometry, length, 0.0), prepared)


def _from_root(of_edge: Tensor, prepared: Prepared) -> np.ndarray:
    """``(N,)`` sums of values ``(M,)`` of edges along the forest, from each node's root on."""
    parent_edge = prepared.forest.parent_edge
    return accumulate_to_root(prepared.forest, np.where(parent_edge >= 0, of_edge.double().numpy()[parent_edge], 0.0))


def _moved(mode: Mode, before: Drawn, after: Drawn) -> State:
    """A mode's labels, noise and orientations on the same graph drawn together anew."""
    correction = after.prepared.closure_graph.corrections(before.orientations(mode.state))
    return replace(mode.state, correction=np.ascontiguousarray(correction.numpy().T))
