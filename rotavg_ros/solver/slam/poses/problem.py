"""A labelling of a robot's graph, with translations: its chains, axes, runs and jumps."""

from __future__ import annotations

from dataclasses import dataclass, field, replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.odometry_lengths import typical_length, ways_passed
from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.algebra.sparse.block_system import BlockEquations
from rotavg_ros.solver.running.cached import cached_property
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.graph.routes import way_along
from rotavg_ros.solver.slam.poses.closures import Told
from rotavg_ros.solver.slam.poses.displacements import Displacements, DrawnSteps
from rotavg_ros.solver.slam.poses.even.turns import EvenTurns
from rotavg_ros.solver.slam.poses.priors import PlacePriors
from rotavg_ros.solver.slam.poses.state import PoseState
from rotavg_ros.solver.slam.posterior.densities import anyhow, log_false, log_good
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.rows import tails, variances
from rotavg_ros.solver.slam.posterior.state import RUN_STEPS
from rotavg_ros.solver.slam.posterior.system import NormalEquations
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Motion counts as planar if shifts off the plane are below this share of the longest.
_PLANAR = 1e-6
# Cosine of the angle to the normal up to which the first axis is projected onto a plane, else the second.
_ALONG = 0.9
# Least length of a step that jumps, as a share of a typical step; steps that err by the way alone err by that of this.
LEAST_LENGTH = 1e-3
# Closures longer than this many times all of odometry are clipped to that length.
_FARTHEST = 1e3


def crossing(turns: np.ndarray, shifts: np.ndarray) -> np.ndarray:
    """``(3, m k)`` map from v to the entries of v × in bases ``(3, k)`` and ``(3, m)``: (v × a) · b = v · (a × b)."""
    return np.asarray(np.cross(turns.T[None], shifts.T[:, None]).reshape(-1, 3).T)


@dataclass(frozen=True)
class PoseProblem:
    """A labelling of a robot's graph, with translations (E edges: S segments first; C closures).

    Attributes:
        graph: the view-graph whose odometry was contracted, N nodes and M edges.
        translation: ``(M, 3)`` position of the target in the source's frame, metres; NaN where unknown, of what
            is not the chain.
        mode: the labelling by rotations alone.
        priors: of translations.
        jump: ``(M,)`` m² per component, variance of the jump of each edge of odometry; 0 where there is none. None:
            nowhere.
        extent: m² per component, variance of the distance between two places of the map, for labellings that are
            compared: how many pairs of places a front end may confuse does not depend on where one puts them. None: of
            the places as they are.
    """

    graph: ViewGraph
    translation: np.ndarray
    mode: Mode
    priors: PlacePriors = field(default_factory=PlacePriors)
    jump: np.ndarray | None = None
    extent: float | None = None

    @cached_property
    def drawn(self) -> ClosureGraph:
        """The contracted graph, with nodes placed along segments in proportion to odometry's variance."""
        return self.mode.problem.drawn(self.mode.state.noise)

    @cached_property
    def beside(self) -> np.ndarray:
        """``(B,)`` edges that are sound odometry beside the chain, and state translations."""
        edge = self.mode.problem.beside[self.mode.state.is_good[self.mode.problem.beside]]
        stated = self.translation[self.drawn.view_graph_edge[edge - self.drawn.num_segments]]
        return np.asarray(edge[np.isfinite(stated).all(axis=1)])

    @cached_property
    def lengths(self) -> np.ndarray:
        """``(M, 3)`` translations, 0 where unknown; those of closures are clipped to ``_FARTHEST`` times odometry's."""
        known = np.isfinite(self.translation).all(axis=1, keepdims=True)
        lengths = np.where(known, self.translation, 0.0)
        is_odometry = self.graph.is_odometry.numpy()
        farthest = _FARTHEST * float(np.abs(lengths[is_odometry]).sum())
        return np.where(is_odometry[:, None], lengths, np.clip(lengths, -farthest, farthest))

    @cached_property
    def way(self) -> np.ndarray:
        """``(M,)`` metres travelled along each edge's steps."""
        return ways_passed(self.lengths, way_along(self.graph))

    @cached_property
    def typical(self) -> float:
        """Metres, length of a typical step of odometry."""
        return typical_length(self.way, self.graph.steps.numpy(), self.graph.is_odometry.numpy())

    @cached_property
    def travelled(self) -> np.ndarray:
        """``(M, 2)`` metres, and steps, of each edge."""
        return np.stack((self.way, self.graph.steps.numpy()), axis=1)

    @cached_property
    def bases(self) -> tuple[np.ndarray, np.ndarray]:
        """``(3, k)`` axes of turns and ``(3, m)`` of shifts: one and two where all motion is in a plane, else three."""
        if self.mode.problem.components == 3:
            return np.eye(3), np.eye(3)
        told = self.graph.tells_dimension
        vectors = rotations.log(self.graph.target_from_source[told]).numpy()
        normal = np.linalg.eigh(vectors.T @ vectors)[1][:, 2]
        off = np.abs(self.lengths[told.numpy()] @ normal).max(initial=0.0)
        is_planar = off <= _PLANAR * np.abs(self.lengths).max(initial=0.0)
        return normal[:, None], _across(normal) if is_planar else np.eye(3)

    @cached_property
    def drift_axis(self) -> np.ndarray | None:
        """``(3,)`` unit vector of the world, the vertical, where the robot knows one; None: all axes are alike."""
        problem = self.mode.problem
        known = problem.upright if self.turns == 3 and "tilt" not in problem.without else None
        if known is None:
            return None
        sound = np.flatnonzero(self.mode.state.is_good[: self.drawn.num_segments])
        return known.sharpened(self.mode.evaluation.residual[sound], self.own[sound])

    @cached_property
    def about_drift_axis(self) -> np.ndarray:
        """``(k, k)`` projection of a turn onto the drift axis; the identity where there is none."""
        return np.eye(self.turns) if self.drift_axis is None else np.outer(self.drift_axis, self.drift_axis)

    @cached_property
    def even_turns(self) -> EvenTurns:
        """Units in which the rows' turns err alike about all axes.

        Where gravity holds some axes these are known, and closures' residuals by rotations alone would seem to err
        about the vertical, as odometry does.
        """
        if self.turns < 3 or self.drift_axis is not None or "body-axes" in self.mode.problem.without:
            return EvenTurns.alike(len(self.drawn.source), self.turns)
        return EvenTurns.of(self.mode)

    @property
    def num_about(self) -> int:
        """Number of components of a turn about the drift axis; all of them where there is none."""
        return self.turns if self.drift_axis is None else 1

    @property
    def turns(self) -> int:
        """Number of components of a turn, k."""
        return int(self.bases[0].shape[1])

    @property
    def shifts(self) -> int:
        """Number of components of a shift, m."""
        return int(self.bases[1].shape[1])

    @cached_property
    def own(self) -> np.ndarray:
        """``(E,)`` rad², variance of the noise of each turn."""
        return variances(self.mode.problem, self.mode.state.noise)[: len(self.drawn.source)]

    @cached_property
    def runs(self) -> NormalEquations:
        """Runs with common errors: translations always have them; the length is that of turns, if these have them."""
        noise = self.mode.state.noise
        return self.mode.problem.system(noise if noise.run_steps > 0 else replace(noise, run_steps=RUN_STEPS[-1]))

    @property
    def steps_err(self) -> bool:
        """Whether a part of the error of odometry's shifts does not depend on the steps' lengths."""
        return "step-errors" not in self.mode.problem.without

    @property
    def turns_share(self) -> bool:
        """Whether turns of closures that are near each other err alike."""
        return self.mode.state.noise.run_steps > 0

    @cached_property
    def run(self) -> np.ndarray:
        """``(E,)`` number of the run whose error each edge shares, or -1."""
        return np.where(self.runs.shared, self.runs.run, -1)

    @cached_property
    def sign(self) -> np.ndarray:
        """``(E,)`` sign of the common error in each edge, 0 if it has none."""
        return np.where(self.run >= 0, self.runs.sign, 0.0)

    @property
    def num_runs(self) -> int:
        return self.runs.num_runs

    @cached_property
    def slipped(self) -> np.ndarray:
        """``(S,)`` bool, segments that slipped."""
        return np.asarray(~self.mode.state.is_good[: self.drawn.num_segments])

    @cached_property
    def jumps(self) -> np.ndarray:
        """``(S,)`` m² per component, variance of the jump of each segment's shift; 0 where there is none."""
        of_segment = np.zeros(self.drawn.num_segments)
        if self.jump is not None:
            segment = self.drawn.segment_of_edge
            on_segment = np.flatnonzero(segment >= 0)
            np.maximum.at(of_segment, segment[on_segment], self.jump[on_segment])
        return of_segment

    @cached_property
    def _step_reports(self) -> np.ndarray:
        """``(M,)`` metres, longest step that each edge may contain: of several steps, the rest beside typical ones."""
        steps = self.graph.steps.numpy()
        return np.asarray(np.maximum(self.way - (steps - 1) * self.typical, self.way / steps))

    @cached_property
    def _could_jump_by(self) -> np.ndarray:
        """``(M,)`` metres by which each edge could jump, about; 0 where somebody has accepted it."""
        is_accepted = (self.graph.label == EdgeLabel.ACCEPTED).numpy()
        return np.where(is_accepted, 0.0, np.maximum(self._step_reports, LEAST_LENGTH * self.typical))

    @cached_property
    def longest_steps(self) -> np.ndarray:
        """``(S,)`` the edge with the longest reported step in each segment, of those that could jump."""
        segment = self.drawn.segment_of_edge
        edge = np.flatnonzero(segment >= 0)
        order = np.lexsort((-self._could_jump_by[edge], segment[edge]))
        return np.asarray(edge[order][np.unique(segment[edge][order], return_index=True)[1]])

    @cached_property
    def could_jump(self) -> np.ndarray:
        """``(S,)`` m² per component, variance of a jump of each segment: the square of its longest reported step.

        0 where all of a segment's steps are accepted.
        """
        return np.asarray(self._could_jump_by[self.longest_steps] ** 2)

    @cached_property
    def tailed(self) -> np.ndarray:
        """``(S,)`` factor of each segment's variance due to tails, as weighted in the last solve."""
        return np.asarray(1 / self.mode.state.others.relative[: self.drawn.num_segments])

    @cached_property
    def segment_of_node(self) -> np.ndarray:
        """``(N,)`` the segment within which each node lies; -1 for key nodes."""
        drawn = self.drawn
        inner = np.flatnonzero(drawn.paths.hangs_on_odometry & (drawn.above != drawn.below))
        segment = np.full(self.graph.num_nodes, -1)
        segment[inner] = drawn.segment_of_edge[drawn.paths.forest.parent_edge[inner]]
        return segment

    @cached_property
    def steps(self) -> np.ndarray:
        """``(S,)`` variance of each segment's turn, in units of that of one step."""
        return self.own[: self.drawn.num_segments] / self.mode.state.noise.step_variance

    @cached_property
    def closures(self) -> np.ndarray:
        """``(C,)`` the view-graph's edges of the closures."""
        return np.asarray(self.drawn.view_graph_edge[self.mode.problem.closure - self.drawn.num_segments])

    @cached_property
    def chain_number(self) -> np.ndarray:
        """``(K,)`` number, from 0, of the chain of odometry that each key node belongs to."""
        return np.asarray(np.unique(self.drawn.chain, return_inverse=True)[1])

    @cached_property
    def chains(self) -> np.ndarray:
        """``(C, 2)`` numbers, from 0, of the chains of odometry at closures' ends."""
        drawn, closure = self.drawn, self.mode.problem.closure
        return np.asarray(self.chain_number[np.stack((drawn.source[closure], drawn.target[closure]), axis=1)])

    @cached_property
    def within_chain(self) -> np.ndarray:
        """``(C,)`` bool, closures whose ends odometry joins."""
        return np.asarray(self.chains[:, 0] == self.chains[:, 1])

    @cached_property
    def stated_square(self) -> np.ndarray:
        """``(C,)`` m², squared lengths that closures state."""
        return np.asarray((self.lengths[self.closures] ** 2).sum(axis=1))

    @cached_property
    def told(self) -> Told:
        """What rotations alone say of closures."""
        problem, state, left_out = self.mode.problem, self.mode.state, self.mode.left_out
        closure, k = problem.closure, problem.components
        tailed = tails(problem, state.noise).of(closure)
        square, predicted = left_out.square[closure], left_out.predicted[closure]
        good, _ = log_good(square, self.own[closure], predicted, k, tailed)
        odds = problem.log_odds[closure]
        label = np.where(np.isinf(odds), np.sign(odds), 0.0)
        with np.errstate(invalid="ignore"):
            false_odds = np.where(label == 0, good - left_out.log_odds[closure], 0.0)
        # A similar-looking place is seen at nearly the angle at which the true one would be, which may be uncertain.
        priors = problem.priors
        broad = predicted / (1 + predicted / anyhow(k))
        false_odds += log_false(square, k, priors, predicted=broad) - log_false(square, k, priors)
        is_known = np.isfinite(self.translation).all(axis=1)[self.closures]
        own = self.own[closure] / state.others.relative[closure]
        order = problem.detection, problem.detected
        uneven = self.even_turns.uneven[closure]
        of_runs = problem.run, problem.follows, problem.sign
        return Told(own, uneven, false_odds, is_known, label, self.chains, *of_runs, *order)

    @cached_property
    def equations(self) -> BlockEquations:
        """The pattern of the joint system."""
        drawn = self.drawn
        ends = np.stack((drawn.source, drawn.target), axis=1)
        return BlockEquations((self.turns, self.shifts), drawn.num_nodes, ends, self.run, drawn.roots, self.loose)

    @cached_property
    def loose(self) -> np.ndarray:
        """Key nodes at which chains of odometry begin, except chains with a root."""
        drawn = self.drawn
        chain = drawn.chain
        first = np.unique(chain, return_index=True)[1]
        return np.asarray(first[~np.isin(chain[first], chain[drawn.roots])])

    def orientations(self, state: PoseState) -> np.ndarray:
        """``(N, 4)`` body_from_world of all nodes."""
        correction = torch.from_numpy(np.ascontiguousarray(state.correction.T))
        return np.asarray(self.drawn.orientations(correction).numpy())

    @cached_property
    def drawn_steps(self) -> DrawnSteps:
        """Odometry's steps, in the order of the segments."""
        by_turns = self.mode.problem.by_turns(self.mode.state.noise)
        return DrawnSteps(self.graph, self.lengths, self.travelled, self.drawn, self.steps, by_turns)

    def displacements(self, body_from_world: np.ndarray) -> Displacements:
        """Displacements at orientations ``(N, 4)``."""
        return self.drawn_steps.displacements(body_from_world)

    def along_odometry(self, way: Displacements) -> np.ndarray:
        """``(K, 3)`` metres, positions of the key nodes by odometry's displacements from its roots."""
        drawn = self.drawn
        forest = drawn.paths.forest
        step = np.zeros((self.graph.num_nodes, 3))
        segments = slice(drawn.num_segments)
        step[drawn.nodes[drawn.target[segments]]] = way.displacement[segments]
        from_root = [accumulate_to_root(forest, column) for column in step.T]
        return np.asarray(np.stack(from_root, axis=1)[drawn.nodes])


def _across(normal: np.ndarray) -> np.ndarray:
    """``(3, 2)`` axes of the plane across a unit vector ``(3,)``: the same ones for nearly the same plane."""
    normal = normal * np.sign(normal[np.argmax(np.abs(normal))])
    # Not the axis that is least along the normal: of a level plane rounding would tell which.
    first = np.eye(3)[int(abs(normal[0]) > _ALONG)]
    first = first - (first @ normal) * normal
    first /= np.linalg.norm(first)
    return np.stack((first, np.cross(normal, first)), axis=1)
