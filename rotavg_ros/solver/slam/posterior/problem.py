"""What stays fixed while labels, noise and orientations change: the graph, its runs of closures, prior log-odds."""

from __future__ import annotations

import copy
from collections.abc import Collection
from dataclasses import dataclass, field, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.graph.agreement import AgreementPairs, closure_ends
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.noise.vertical import Vertical
from rotavg_ros.solver.slam.posterior.calibration import Calibrated
from rotavg_ros.solver.slam.posterior.priors import SearchLimits, SlamPriors
from rotavg_ros.solver.slam.posterior.state import RUN_STEPS, Noise
from rotavg_ros.solver.slam.posterior.system import NormalEquations
from rotavg_ros.solver.slam.preparation import Prepared

# Stands for a share of zero; its logarithm is finite.
_NONE = 1e-12
# Turns that differ relatively by less do not let their effect be estimated.
_SAME_TURNS = 0.1


@dataclass(frozen=True)
class Problem:
    """A closure graph (K key nodes, E edges, C closures) and what is known of it.

    Attributes:
        graph: the closure graph.
        components: k, 1 where all rotations share an axis, else 3.
        log_odds: ``(E,)`` log-odds that each edge is good, by networks and labels, beyond those common to all; ±inf
            decide.
        chain: ``(C,)`` number of each closure's chain, in which each closure is near the next.
        follows: ``(C,)`` the nearest closure that was detected before and is near enough to share the label, or -1.
        priors: all prior parameters.
        limits: limits of the search.
        without: names of terms and moves that are switched off (:data:`rotavg_ros.solver.slam.options.SWITCHES`).
        calibrated: the calibration that was removed from all odometry or all closures, if any.
        turned: ``(N,)`` rad², sum of the squared turns of odometry's steps from each node's root; None if unknown.
        travelled: ``(N,)`` metres of odometry from each node's root; None if unknown.
        relative: ``(E,)`` each edge's own variance by FineNet over that by the noise model; None: 1.
    """

    graph: ClosureGraph
    components: int
    log_odds: np.ndarray
    chain: np.ndarray
    follows: np.ndarray
    priors: SlamPriors
    limits: SearchLimits = field(default_factory=SearchLimits)
    without: frozenset[str] = frozenset()
    calibrated: Calibrated | None = None
    turned: np.ndarray | None = None
    travelled: np.ndarray | None = None
    relative: np.ndarray | None = None
    _systems: dict[float, NormalEquations] = field(default_factory=dict, init=False, repr=False, compare=False)

    @classmethod
    def of(
        cls,
        prepared: Prepared,
        log_odds: np.ndarray,
        *,
        priors: SlamPriors | None = None,
        without: Collection[str] = (),
        calibrated: Calibrated | None = None,
        turned: np.ndarray | None = None,
    ) -> Problem:
        """Find the chains of closures that follow each other closely.

        Args:
            prepared: the contracted graph, with its neighbouring closures.
            log_odds: ``(E,)`` log-odds of each edge by itself. A network judges the closures of a run by the same
                evidence, so that all closures of a run together count once.
        """
        priors = SlamPriors() if priors is None else priors
        graph, pairs, components = prepared.closure_graph, prepared.pairs, prepared.noise.components
        if "near-misses" in without:
            priors = replace(priors, near_miss_share=_NONE)
        chain = _chains(graph, pairs, priors)
        told = log_odds.copy()
        if len(chain):
            run = runs_of(graph, chain, RUN_STEPS[-1])
            told[graph.is_closure] /= np.bincount(run)[run]
        if "slips" in without:
            told[graph.is_odometry] = np.inf
        follows = _predecessors(graph, pairs, priors)
        return cls(
            graph,
            components,
            told,
            chain,
            follows,
            priors,
            without=frozenset(without),
            calibrated=calibrated,
            turned=turned,
        )

    def with_relative(self, relative: np.ndarray) -> Problem:
        """The same problem with variances multiplied by ``relative`` ``(E,)``; the sparsity patterns are shared."""
        other = copy.copy(self)
        object.__setattr__(other, "relative", relative)
        return other

    @cached_property
    def closure(self) -> np.ndarray:
        """``(C,)`` edges that are closures."""
        return np.flatnonzero(self.graph.is_closure)

    @cached_property
    def beside(self) -> np.ndarray:
        """``(B,)`` edges that are odometry beside the chain."""
        return np.flatnonzero(self.graph.is_beside)

    @cached_property
    def sign(self) -> np.ndarray:
        """``(C,)`` +1 where a closure runs from its older to its newer end, else −1."""
        return np.asarray(np.where(self.graph.is_forward, 1.0, -1.0)[self.closure])

    @cached_property
    def measured(self) -> np.ndarray:
        """``(4, E)`` measured residuals under the odometry's orientations."""
        return np.ascontiguousarray(self.graph.residual.numpy().T)

    def body_from_world(self, correction: np.ndarray) -> np.ndarray:
        """``(K, 3, 3)`` orientations of key nodes under corrections ``(4, K)``."""
        return quaternion_rows.matrices(quaternion_rows.multiply(self._body_from_world, correction))

    @cached_property
    def _body_from_world(self) -> np.ndarray:
        """``(4, K)`` orientations of key nodes by odometry."""
        return np.ascontiguousarray(self.graph.odometry_orientation.numpy()[self.graph.nodes].T)

    @cached_property
    def ends(self) -> np.ndarray:
        """``(C, 2)`` older and newer end, in steps along the odometry."""
        return closure_ends(self.graph, self.closure)

    @cached_property
    def detection(self) -> np.ndarray:
        """``(C,)`` closures in the order of their detection, which is that of their newer ends."""
        return _detection(self.ends)

    @cached_property
    def detected(self) -> np.ndarray:
        """``(C,)`` rank of each closure in the order of detection."""
        return np.argsort(self.detection)

    @cached_property
    def preceded(self) -> np.ndarray:
        """``(C,)`` the closure detected immediately before each, if it was shortly before, else -1."""
        newer = self.ends[self.detection, 1]
        is_near = np.diff(newer) <= self.priors.run_gap_steps
        preceded = np.full(len(newer), -1, dtype=np.int64)
        preceded[self.detection[1:]] = np.where(is_near, self.detection[:-1], -1)
        return preceded

    @cached_property
    def stated_ratio(self) -> np.ndarray:
        """``(C,)`` logarithm of stated variances over the typical one, the median; 0 where unknown or absurd."""
        stated = self.graph.stated_variance[self.closure]
        with np.errstate(invalid="ignore", divide="ignore"):
            logarithm = np.log(stated)
        is_known = np.isfinite(logarithm)
        if not is_known.any():
            return np.zeros(len(stated))
        ratio = np.where(is_known, logarithm, 0.0) - np.median(logarithm[is_known])
        is_sane = is_known & (np.abs(ratio) <= np.log(self.priors.largest_stated_ratio))
        return np.where(is_sane, np.maximum(ratio, np.log(self.priors.least_stated_ratio)), 0.0)

    @cached_property
    def upright(self) -> Vertical | None:
        """The vertical about which the robot stays upright; None if there is none, or several robots differ in it."""
        return None if self.components == 1 else Vertical.of(self.graph.odometry_orientation)

    @property
    def vertical(self) -> Vertical | None:
        """The same, for false closures' turns."""
        return None if "vertical" in self.without else self.upright

    @cached_property
    def run(self) -> np.ndarray:
        """``(C,)`` number of each closure's run, for the largest length of runs."""
        return runs_of(self.graph, self.chain, RUN_STEPS[-1])

    def allowed(self, trusted: np.ndarray) -> np.ndarray:
        """Labels ``(E,)``, 1 where a user has accepted an edge and 0 where one was rejected, whatever they were."""
        return np.where(np.isinf(self.log_odds), self.log_odds > 0, trusted)

    def system(self, noise: Noise) -> NormalEquations:
        """Normal equations; runs of two or more closures have a common error."""
        if noise.run_steps not in self._systems:
            self._systems[noise.run_steps] = self._system(noise.run_steps)
        return self._systems[noise.run_steps]

    def _system(self, run_steps: float) -> NormalEquations:
        graph = self.graph
        column = np.full(len(graph.source), -1, dtype=np.int64)
        if len(self.chain) and run_steps > 0 and "common-errors" not in self.without:
            run = runs_of(graph, self.chain, run_steps)
            is_shared = np.bincount(run)[run] >= 2
            column[self.closure[is_shared]] = np.unique(run[is_shared], return_inverse=True)[1].reshape(-1)
        sign = np.zeros(len(graph.source))
        sign[self.closure] = self.sign
        return NormalEquations(graph.num_nodes, graph.source, graph.target, column, sign, roots=graph.roots)

    @cached_property
    def is_held(self) -> bool:
        """Whether odometry alone connects all that the graph connects."""
        graph = self.graph
        ends = graph.source[graph.is_odometry], graph.target[graph.is_odometry]
        links = coo_array((np.ones(len(ends[0])), ends), shape=(graph.num_nodes,) * 2)
        return bool(connected_components(links, directed=False)[0] == len(graph.roots))

    @cached_property
    def total_steps(self) -> float:
        """Number of steps of all odometry."""
        return float(self.graph.own_steps[self.graph.is_odometry].sum())

    @cached_property
    def _passed(self) -> np.ndarray:
        """``(3, N)`` steps of odometry from each node's root: by number, squared turns and metres; equal in total."""
        steps = np.asarray(self.graph.paths.depth, dtype=np.float64)
        turned = None if "turns" in self.without else self.turned
        return np.stack((steps, self._as_steps(turned), self._as_steps(self.travelled)))

    def _as_steps(self, passed: np.ndarray | None) -> np.ndarray:
        """``(N,)`` what was passed from the root, scaled to the total number of steps; the steps if it is unknown."""
        graph = self.graph
        steps = np.asarray(graph.paths.depth, dtype=np.float64)
        if passed is None:
            return steps
        segments = slice(graph.num_segments)
        of_segments = passed[graph.nodes[graph.target[segments]]] - passed[graph.nodes[graph.source[segments]]]
        total = float(of_segments.sum())
        return passed * float(graph.own_steps[segments].sum()) / total if total > 0 else steps

    @cached_property
    def turn_steps(self) -> np.ndarray:
        """``(E,)`` the same total of steps, distributed over segments by their squared turns."""
        return self._of_segments(1)

    @cached_property
    def length_steps(self) -> np.ndarray:
        """``(E,)`` the same total of steps, distributed over segments by their lengths in metres."""
        return self._of_segments(2)

    def _of_segments(self, row: int) -> np.ndarray:
        graph = self.graph
        segments = np.arange(graph.num_segments)
        passed = self._passed[row][graph.nodes]
        steps = graph.own_steps.copy()
        steps[segments] = passed[graph.target[segments]] - passed[graph.source[segments]]
        return np.asarray(steps)

    def drawn(self, noise: Noise) -> ClosureGraph:
        """The graph with nodes placed along their segments in proportion to odometry's variance under ``noise``."""
        steps, turns, _ = self._passed
        drawn = self.graph if noise.turn_share == 0 else self.graph.passing(steps + noise.turn_share * (turns - steps))
        return drawn if self.relative is None else drawn.varying(self.relative)

    def by_turns(self, noise: Noise) -> np.ndarray:
        """``(M,)`` part of odometry's edge variances that is proportional to squared turns under ``noise``."""
        forest, share = self.graph.paths.forest, noise.turn_share
        out = np.zeros(len(self.graph.segment_of_edge))
        if share == 0:
            return out
        child = np.flatnonzero(forest.parent_edge >= 0)
        steps, turns = self._passed[:2, child] - self._passed[:2, forest.parent[child]]
        total = (1 - share) * steps + share * turns
        out[forest.parent_edge[child]] = np.divide(share * turns, total, out=np.zeros_like(total), where=total > 0)
        return out

    @cached_property
    def turns_vary(self) -> bool:
        """Whether some parts of odometry turn more than others."""
        odometry = self.graph.is_odometry
        return not np.allclose(self.turn_steps[odometry], self.graph.own_steps[odometry], rtol=_SAME_TURNS)


def _chains(graph: ClosureGraph, pairs: AgreementPairs, priors: SlamPriors) -> np.ndarray:
    """``(C,)`` number of the chain that each closure belongs to."""
    count = int(graph.is_closure.sum())
    linked = pairs.steps <= priors.run_gap_steps
    links = coo_array((np.ones(int(linked.sum())), (pairs.first[linked], pairs.second[linked])), shape=(count,) * 2)
    return np.asarray(connected_components(links, directed=False)[1])


def runs_of(graph: ClosureGraph, chain: np.ndarray, run_steps: float) -> np.ndarray:
    """``(C,)`` number of each closure's run: its chain, cut every ``run_steps`` of odometry at the older end."""
    older = closure_ends(graph, np.flatnonzero(graph.is_closure))[:, 0]
    start = np.full(int(chain.max(initial=-1)) + 1, np.inf)
    np.minimum.at(start, chain, older)
    stretch = np.stack((chain, (older - start[chain]) // run_steps), axis=1)
    return np.asarray(np.unique(stretch, axis=0, return_inverse=True)[1], dtype=np.int64).reshape(-1)


def _detection(ends: np.ndarray) -> np.ndarray:
    return np.lexsort((ends[:, 0], ends[:, 1]))


def _predecessors(graph: ClosureGraph, pairs: AgreementPairs, priors: SlamPriors) -> np.ndarray:
    """``(C,)`` the nearest earlier closure whose two ends are near those of each closure, or -1."""
    closure = np.flatnonzero(graph.is_closure)
    follows = np.full(len(closure), -1, dtype=np.int64)
    if len(pairs.first) == 0:
        return follows
    detected = np.argsort(_detection(closure_ends(graph, closure)))
    is_before = (detected[pairs.second] < detected[pairs.first]) & (pairs.steps <= priors.run_gap_steps)
    later, earlier, steps = pairs.first[is_before], pairs.second[is_before], pairs.steps[is_before]
    order = np.lexsort((-detected[earlier], steps, later))
    found, first = np.unique(later[order], return_index=True)
    follows[found] = earlier[order][first]
    return follows
