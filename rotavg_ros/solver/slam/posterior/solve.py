"""Searches the posterior of a robot's graph, with and without corrections of systematic errors (calibration)."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass, replace
from operator import attrgetter
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.odometry_lengths import ways_passed
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.running.work import spend
from rotavg_ros.solver.slam.graph.routes import way_along
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.calibration import PARTS, Calibration, calibrated
from rotavg_ros.solver.slam.noise.mounting import ALIKE, between_axes, estimate_mountings, is_about_as_said, may_be_told
from rotavg_ros.solver.slam.noise.turns import squared_turns
from rotavg_ros.solver.slam.noise.vertical import MOST_TILT, Vertical
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.posterior.em import polish
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.problem import Problem
from rotavg_ros.solver.slam.posterior.state import State
from rotavg_ros.solver.slam.preparation import Prepared, likely_bias, made_of_odometry, prepare_as_it_is
from rotavg_ros.solver.slam.stages import CleanedClosures, clean
from rotavg_ros.view_graph import ViewGraph

# Maximum number of rounds that improve a part of the calibration, and the least decrease of F, nats, for another round.
_ROUNDS, _LEAST_GAIN = 8, 0.5
# A step on the bias tells of one if residuals gain this many nats, two standard deviations.
_TELLS = 2.0
# A labelling with or without a bias is left to translations if F is higher by less than this, nats.
_HARDLY = 5.0
# A mounting that lowers F by this many nats is reported.
_SUSPICIOUS = 5.0
# Units of work per edge to prepare a problem.
_EDGE = 0.002


@dataclass(frozen=True)
class Drawn:
    """A contracted graph and its problem.

    Attributes:
        prepared: the contracted graph, after systematic errors were removed, if any.
        cleaned: CleanNet's verdict on its closures.
        problem: the problem that the posterior is defined on.
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
        """Contracts the graph after the calibration, if any, is removed from the measurements.

        ``components`` is k, if it is to differ from that of the corrected rotations.
        """
        corrected = calibrated(graph, calibration)
        restated: np.ndarray | None = None
        if "restated" in without:
            restated = np.zeros(graph.num_edges, dtype=bool)
        elif calibration is not None:
            restated = made_of_odometry(graph)
        prepared = prepare_as_it_is(corrected, components, restated)
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
    """What the search found.

    Attributes:
        drawn: the contracted graph, after the calibration was removed, if any.
        modes: its modes, in order of increasing F.
        suspected: ``(3,)`` rad, apparent rotation between the axes of closures and odometry, if either may be wrong.
        tilts: nats, −log density of the answer's tilts, by which answers with and without a bias are compared.
        otherwise: the likeliest without a bias where this has one, or with one where it has none; None: none was found.
    """

    drawn: Drawn
    modes: list[Mode]
    suspected: np.ndarray | None = None
    tilts: float = 0.0
    otherwise: Found | None = None

    @property
    def cost(self) -> float:
        """F of the best mode, nats."""
        return self.modes[0].cost

    @property
    def total(self) -> float:
        """F of the best mode, and tilts, nats."""
        return self.cost + self.tilts

    @property
    def is_undecided(self) -> bool:
        """Whether what was found otherwise is nearly as likely."""
        return self.otherwise is not None and self.otherwise.total < self.total + _HARDLY

    @property
    def calibration(self) -> Calibration | None:
        """The calibration that was removed from the measurements, if any."""
        taken_out = self.drawn.problem.calibrated
        return None if taken_out is None else taken_out.calibration

    @property
    def is_biased(self) -> bool:
        """Whether a gyroscope's bias was removed."""
        return self.calibration is not None and bool(self.calibration.bias.any())

    @property
    def mounting(self) -> np.ndarray:
        """``(3,)`` rad, the mounting error that was removed from closures."""
        return np.zeros(3) if self.calibration is None else self.calibration.mounting

    @property
    def is_mounted_nearby(self) -> bool:
        """Whether the mounting error removed from closures may as well be an error of odometry."""
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
    """The labellings of least F of a graph without repeated edges.

    Args:
        graph: N nodes.
        network: CleanNet, or None to do without it.
        begin: function that gives the corrections ``(K, 4)`` to begin with: along CleanNet's tree, or of an earlier
            answer.
        without: terms and moves that are switched off.
        priors: default: the usual ones.
    """
    solver = _Solver(graph, network, begin, without, priors, [])
    as_said = solver.from_starts(None)
    likely = {part: solver.likely(as_said, part) for part in PARTS if part not in without}
    found, suspected = solver.with_parts(as_said, likely), None
    if found.is_mounted_nearby:
        # It may as well be an error of odometry.
        mounted = found
        found = solver.with_parts(as_said, {part: each for part, each in likely.items() if part != "mounting"})
        if mounted.cost < found.cost - _SUSPICIOUS and np.linalg.norm(mounted.mounting) > ALIKE:
            suspected = mounted.mounting
    found = solver.about_vertical(found)
    left = calibrated(graph, found.calibration)
    if left.rotation_components < graph.rotation_components:
        # After the correction all rotations, and so their errors, are about one axis.
        found = solver.from_starts(found.calibration, left.rotation_components)
        return replace(found, suspected=suspected)
    found, *others = (replace(each, tilts=solver.tilts(each)) for each in (found, as_said, *solver.tried))
    could = (each for each in others if each.is_biased != found.is_biased and not each.is_mounted_nearby)
    return replace(found, suspected=suspected, otherwise=min(could, key=attrgetter("total"), default=None))


class _Predicted(NamedTuple):
    """What a Newton step promises.

    Attributes:
        cost: change of F, nats, with noise and labels as they are.
        gain: nats of it that are due to residuals.
        calibration: after the step.
    """

    cost: float
    gain: float
    calibration: Calibration


class _Solver(NamedTuple):
    """The arguments of :func:`search`, and what was found with other calibrations on the way."""

    graph: ViewGraph
    network: SlamCleanNet | None
    begin: Begin
    without: Collection[str]
    priors: SlamPriors | None
    tried: list[Found]

    def from_starts(self, calibration: Calibration | None, components: int | None = None) -> Found:
        """Result from all starts after a calibration is removed; by default k is that of the graph."""
        drawn = self._drawn(calibration, components)
        begun = Search(drawn.problem)
        begun.run(drawn.prepared, drawn.cleaned, self.begin(drawn.prepared, drawn.cleaned))
        return Found(drawn, begun.modes)

    def likely(self, found: Found, part: str) -> list[Found]:
        """Results from all starts with one more part of the calibration, as likely from closures beside odometry."""
        before = found.calibration or Calibration.none()
        values = _likely(part, before.taken_out_of(self.graph), found.drawn.prepared)
        return [self.from_starts(replace(before, **{part: value})) for value in values]

    def with_parts(self, as_said: Found, likely: dict[str, list[Found]]) -> Found:
        """The best result with some or no parts of the calibration, starting from the likely values of each."""
        if not likely:
            return as_said
        begun = min([as_said, *(each for of_part in likely.values() for each in of_part)], key=attrgetter("cost"))
        found = self.one_by_one(begun, likely)
        if begun is not as_said and found.calibration is not None and found.calibration.parts == set(likely):
            # What one part explains, another may explain as well.
            found = min(found, self.one_by_one(as_said, likely), key=attrgetter("cost"))
        return found

    def one_by_one(self, found: Found, parts: Collection[str]) -> Found:
        """Result of Newton steps on one part after the other, the most promising first."""
        ordered = sorted(parts, key=lambda part: (self.predicted(found, part).cost, part))
        for part in ordered:
            found = self.with_part(found, part)
        if found.calibration is not None and ordered[0] not in found.calibration.parts:
            found = self.with_part(found, ordered[0])
        return found

    def with_part(self, found: Found, part: str) -> Found:
        """Result of Newton steps with one more part of the calibration.

        After another part was removed, closures may give a different estimate of this one.
        """
        if found.calibration is not None and part not in found.calibration.parts:
            found = min([found, *self.likely(found, part)], key=attrgetter("cost"))
        for _ in range(_ROUNDS):
            better = self._better(found, part)
            if better is None:
                break
            found = better
        return found

    def predicted(
        self, found: Found, part: str, origin: Mode | None = None, axis: np.ndarray | None = None
    ) -> _Predicted:
        """A Newton step from a mode, by default the best, on the parts already calibrated and one more.

        Args:
            found: with its calibration.
            part: the one more.
            origin: the mode.
            axis: ``(3,)`` about which alone a bias is to be, where there is none yet; default: about any.
        """
        mode, before = origin or found.modes[0], found.calibration or Calibration.none()
        before = before if axis is None else replace(before, axis=axis)
        problem, evaluation = mode.problem, mode.evaluation
        prepared, parts = found.drawn.prepared, {part, *before.parts}
        tried = Calibrated.of(before.taken_out_of(self.graph), prepared, before, parts)
        information, change = tried.information(
            problem.graph.source, mode.state, evaluation.residual, evaluation.factorised, problem.priors
        )
        cost = tried.cost(information, problem.priors) - evaluation.terms.get("calibration", 0.0)
        gain = float(change @ information @ change) / 2
        return _Predicted(cost - gain, gain, before.moved(change @ tried.axes))

    def _better(self, found: Found, part: str) -> Found | None:
        """Result of a search from the best mode after that step, if F falls; a bias may also start otherwise.

        Noise, slips and tilts may stand for what a bias does, and where it bends the map by more than a turn, all right
        closures may be held false. So where a step tells of one, F decides with noise of its own, if need be from the
        best mode without its slips, from one that believes these closures, or about the body's vertical alone.
        """
        best = found.modes[0]
        starts: list[tuple[Mode, np.ndarray | None]] = [(best, None)]
        if part == "bias":
            vertical = None if found.is_biased else self._body_vertical(found)
            axes = (None,) if vertical is None else (None, vertical)
            others = [] if found.is_biased else _believing_more(found.modes)
            starts = [(origin, axis) for origin in (best, *_mended(best), *others) for axis in axes]
        for origin, axis in starts:
            step = self.predicted(found, part, origin, axis)
            is_promised = step.cost < -_LEAST_GAIN and axis is None
            if part == "mounting" and np.linalg.norm(step.calibration.mounting) < ALIKE:
                continue
            if not is_promised and (part != "bias" or step.gain < _TELLS):
                continue
            most = np.inf if is_promised and origin is best else found.cost
            better = self._from_mode(origin, found.drawn, step.calibration, most)
            self.tried.append(better)
            gain = found.cost - better.cost
            if part == "bias" and found.drawn.problem.components > 1:
                gain += self.tilts(found) - self.tilts(better)
            if gain > _LEAST_GAIN:
                return better
        return None

    def about_vertical(self, found: Found) -> Found:
        """Result with only that part of a bias that is about the body's vertical, if F falls, tilts included.

        On a robot that stays upright closures tell little of the other parts, and these tilt the map.
        """
        before, axis = found.calibration, self._body_vertical(found)
        if before is None or not before.bias.any() or before.axis is not None or axis is None:
            return found
        upright = replace(before, bias=axis * (axis @ before.bias), axis=axis)
        other = self.with_part(self._from_mode(found.modes[0], found.drawn, upright), "bias")
        return min(found, other, key=lambda either: either.cost + self.tilts(either))

    def _body_vertical(self, found: Found) -> np.ndarray | None:
        """``(3,)`` the vertical in the body of a robot that stays upright but leaves the plane; None for others."""
        problem = found.drawn.problem
        if problem.vertical is None or problem.components == 1:
            return None
        orientations = rotations.to_matrix(found.drawn.orientations(found.modes[0].state)).numpy()
        axis = (orientations @ problem.vertical.axis).mean(axis=0)
        return np.asarray(axis / np.linalg.norm(axis))

    def tilts(self, found: Found) -> float:
        """Nats, −log density of the body's tilts, N(0, τ²) in two components, τ unknown: once for each full turn."""
        vertical = Vertical.of(found.drawn.orientations(found.modes[0].state))
        odometry, variance = self.graph.is_odometry, found.drawn.prepared.noise.step_variance
        square = (rotations.log(self.graph.target_from_source[odometry]) ** 2).sum(dim=1)
        # What noise alone would turn does not count.
        turned = (square - 3 * variance * self.graph.steps[odometry]).clamp_min(0.0).sqrt().sum()
        return float(turned / (2 * np.pi) * np.log(MOST_TILT**2 if vertical is None else vertical.variance))

    def _from_mode(self, origin: Mode, drawn: Drawn, calibration: Calibration, most: float = np.inf) -> Found:
        """Result of a search from a mode with another calibration; not gone on with where F is more than ``most``."""
        again = self._drawn(calibration)
        goes_on = Search(again.problem)
        goes_on.keep(goes_on.flipped(goes_on.polished(_moved(origin, drawn, again), "calibration")))
        if goes_on.modes[0].cost < most:
            goes_on.move_on()
        return Found(again, goes_on.modes)

    def _drawn(self, calibration: Calibration | None, components: int | None = None) -> Drawn:
        """The graph contracted with a calibration. F is compared with that without one, so k is kept by default."""
        k = components or self.graph.rotation_components
        return Drawn.of(self.graph, self.network, self.without, calibration, self.priors, k)


def _likely(part: str, graph: ViewGraph, prepared: Prepared) -> list[np.ndarray]:
    """Likely values ``(3,)`` of a part that was not calibrated yet, from closures beside odometry."""
    if part == "mounting":
        # If all measurements are about one axis, inverted closures are indistinguishable from an upside-down sensor.
        if prepared.noise.components == 1 or not may_be_told(graph):
            return []
        return between_axes(graph) or estimate_mountings(graph, prepared.closure_graph, prepared.noise)
    bias = likely_bias(graph, prepared)
    return [] if bias is None else [bias]


def _travelled(graph: ViewGraph, prepared: Prepared) -> np.ndarray | None:
    """``(N,)`` metres of odometry from each node's root; None unless all are known."""
    if graph.translation is None:
        return None
    length = torch.from_numpy(ways_passed(graph.translation.double().numpy(), way_along(graph)))
    chain = prepared.forest.parent_edge[prepared.forest.parent_edge >= 0]
    if not bool(torch.isfinite(length[chain])[graph.is_odometry[chain]].all()):
        return None
    return _from_root(torch.where(graph.is_odometry, length, 0.0), prepared)


def _from_root(of_edge: Tensor, prepared: Prepared) -> np.ndarray:
    """``(N,)`` sums of the edges' values ``(M,)`` along the forest, from each node's root."""
    parent_edge = prepared.forest.parent_edge
    return accumulate_to_root(prepared.forest, np.where(parent_edge >= 0, of_edge.double().numpy()[parent_edge], 0.0))


def _believing_more(modes: list[Mode]) -> list[Mode]:
    """The likeliest mode with less than half of the false closures of the best; none if there is none."""
    false = int(modes[0].is_false.sum())
    return [mode for mode in modes if 2 * int(mode.is_false.sum()) < false][:1]


def _mended(mode: Mode) -> list[Mode]:
    """The same labels, but that no odometry slipped; none if none did."""
    if not len(mode.slipped):
        return []
    trusted = mode.state.trusted.copy()
    trusted[mode.slipped] = 1.0
    return [Mode(mode.problem, *polish(mode.problem, replace(mode.state, trusted=trusted)), mode.origin)]


def _moved(mode: Mode, before: Drawn, after: Drawn) -> State:
    """A mode's labels, noise and orientations, transferred to the same graph contracted anew."""
    correction = after.prepared.closure_graph.corrections(before.orientations(mode.state))
    return replace(mode.state, correction=np.ascontiguousarray(correction.numpy().T))
