"""The memory of a solve by the posterior for the next solve of the same graph, grown by a few edges.

The next solve begins with the labelling found, its noise and its calibration, and changes only labels of single
closures. The whole search is due again once there are enough new closures that this labelling does not explain: others
only make it likelier. New odometry without closures gives no evidence about older parts.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, field, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.estimate import Estimate, Places
from rotavg_ros.solver.running.kept_labels import KeptLabels
from rotavg_ros.solver.running.resumable import Resumable
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.links import as_closures, as_odometry
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.calibration import Calibration, calibrated
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.publishing.modes import Published
from rotavg_ros.solver.slam.posterior.publishing.notes import notes_of
from rotavg_ros.solver.slam.posterior.state import Noise
from rotavg_ros.solver.slam.stages import outlier_scores
from rotavg_ros.solver.slam.update.columns import Columns
from rotavg_ros.solver.slam.update.copies import Copies
from rotavg_ros.solver.slam.update.grown_edges import begins_with, thinned_out
from rotavg_ros.solver.slam.update.labelled import UNKNOWN, Labelled, solved_from
from rotavg_ros.view_graph import ViewGraph
from rotavg_ros.wording import without_rows

# The whole search is due once unexplained closures exceed the first share of those in the last search, or new ones
# exceed the second; if another answer was nearly as likely, with any new closure.
_MAX_UNEXPLAINED, _MAX_GROWTH = 0.05, 0.25
_FLAGGED = 0.5
_GOOD = 0.5


class UpdateResult(NamedTuple):
    """Result of an update: the answer, and the labelling."""

    estimate: Estimate
    mode: Mode


@dataclass(frozen=True)
class SlamMemory:
    """Memory of a graph of N nodes and M edges, C of them closures.

    Attributes:
        graph: the view-graph.
        trusted: ``(M,)`` 1 for good closures and sound odometry, 0 for others; all edges of a segment have its label.
        noise: noise of that labelling.
        mode: that labelling, as of the last solve; only odometry has been added since.
        calibration: the calibration that was removed from the measurements; None if there was none.
        body_from_world: ``(N, 4)`` found orientations, in their own gauge.
        outlier_score: ``(M,)`` published scores.
        variance: ``(N,)`` rad², published likewise.
        searched: C when the whole search began.
        is_divided: whether another answer was nearly as likely then.
        unexplained: number of closures added since and flagged, and of older ones whose label has changed.
        notes: the whole search's notes on its answer.
        warnings: all warnings about it; None before they have been computed.
        poses: memory of poses, where translations are known.
        ahead: the next whole solve, if one is under way.
        anew: whether that starts from nothing, as a solve without a memory does.
        update: the solve with new closures, if one is under way.
        update_work: units that the last update took.
        columns: columns of new closures, until the update has ended.
        links: ``(n,)`` edges that are odometry in ``graph``, but closures to the caller.
        copies: the caller's graph, if it repeats some of the edges of ``graph``.
    """

    graph: ViewGraph
    trusted: np.ndarray
    noise: Noise
    mode: Mode
    calibration: Calibration | None
    body_from_world: Tensor
    outlier_score: Tensor
    variance: Tensor
    searched: int
    is_divided: bool = False
    unexplained: int = 0
    notes: tuple[str, ...] = ()
    warnings: tuple[str, ...] | None = None
    poses: PoseMemory | None = None
    ahead: Resumable[Estimate] | None = None
    anew: bool = False
    update: Resumable[SlamMemory | None] | None = None
    update_work: float = 0.0
    columns: Columns | None = None
    links: np.ndarray = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    copies: Copies | None = None

    @classmethod
    def of(
        cls, graph: ViewGraph, calibration: Calibration | None, mode: Mode, estimate: Estimate, is_divided: bool
    ) -> SlamMemory:
        """The memory after a whole search.

        Args:
            graph: the graph that was solved.
            calibration: what was removed from its measurements, if anything.
            mode: the labelling to continue from.
            estimate: the published answer, by rotations alone.
            is_divided: whether another answer is nearly as likely.
        """
        problem, state = mode.problem, mode.state
        trusted = problem.graph.edge_values(state.trusted, 1.0)
        told = estimate.body_from_world, estimate.outlier_score, estimate.variance
        notes = estimate.warnings
        searched = int((~graph.is_odometry).sum())
        return cls(graph, trusted, state.noise, mode, calibration, *told, searched, is_divided, notes=notes)

    @classmethod
    def of_labels(
        cls,
        labels: KeptLabels,
        graph: ViewGraph,
        networks: tuple[SlamCleanNet, SlamFineNet],
        body_from_world: Tensor,
        contradicting: np.ndarray,
    ) -> UpdateResult:
        """Solve a graph, of which only the labels of an earlier solve are left.

        Args:
            labels: those of :attr:`labels`.
            graph: N nodes.
            networks: CleanNet and FineNet; FineNet is applied once.
            body_from_world: ``(N, 4)`` start.
            contradicting: ``(n,)`` new closures that are initially false.
        """
        trusted = np.append(labels.trusted, np.full(graph.num_edges - len(labels.trusted), np.nan))
        trusted = np.where(np.isnan(trusted), UNKNOWN, trusted)
        trusted[contradicting] = 0.0
        noise = Noise(*labels.noise.tolist())
        axis = labels.bias_axis if len(labels.bias_axis) else None
        calibration = Calibration.of(labels.calibration, axis) if len(labels.calibration) else None
        found = solved_from(Labelled(trusted, noise, calibration, labels.by_places), graph, networks, body_from_world)
        estimate = estimate_of(found.published)
        told = estimate.body_from_world, estimate.outlier_score, estimate.variance
        searched, unexplained, is_divided = map(int, labels.search)
        is_new = ~labels.are_known(graph.num_edges) & ~graph.is_odometry.numpy()
        unexplained += int((estimate.outlier_score.numpy()[is_new] > _FLAGGED).sum())
        search = searched, bool(is_divided), unexplained
        notes = notes_of(found.mode)
        memory = cls(graph, found.trusted, found.noise, found.mode, calibration, *told, *search, notes)
        return UpdateResult(replace(estimate, memory=memory), found.mode)

    @property
    def labels(self) -> KeptLabels | None:
        """The input of :meth:`of_labels`; None if odometry's position has jumped, which labels do not state."""
        poses, calibration, axis = self.poses, np.zeros(0), np.zeros(0)
        if self.calibration is not None:
            calibration = self.calibration.vector
            axis = axis if self.calibration.axis is None else self.calibration.axis
        places, noise = np.zeros((0, len(self.trusted)), np.float32), np.zeros(0)
        if poses is not None:
            if poses.pose.problem.jump is not None:
                return None
            places, noise = poses.kept(len(self.trusted)), np.array(astuple(poses.noise))
        # A search that is due or under way is due for whoever continues from the labels.
        unexplained = self.unexplained if self.ahead is None else self.with_all_unexplained().unexplained
        search = np.array([self.searched, unexplained, self.is_divided], dtype=np.float64)
        graph = as_closures(self.graph, self.links)
        own = np.array(astuple(self.noise))
        kept = KeptLabels(graph, self.trusted, own, calibration, axis, places, noise, search)
        return kept if self.copies is None else self.copies.labels_of_all(kept)

    @property
    def is_due(self) -> bool:
        """Whether the whole search should run again."""
        num_closures = int((~self.graph.is_odometry).sum())
        grown = num_closures > (1 if self.is_divided else 1 + _MAX_GROWTH) * self.searched
        return grown or self.unexplained > _MAX_UNEXPLAINED * self.searched

    def with_all_unexplained(self) -> SlamMemory:
        """The memory, marked so that a whole search is due."""
        return replace(self, unexplained=self.searched + 1)

    def with_poses(self, poses: PoseMemory) -> SlamMemory:
        """The memory with that of poses, whose judgement of rotations replaces closures' labels."""
        trusted = self.trusted.copy()
        trusted[poses.edge] = poses.places.rotation_good > _GOOD
        return replace(self, poses=poses, trusted=trusted)

    def since(self, before: SlamMemory, score: Tensor) -> SlamMemory:
        """The memory, with the count of closures that the labelling does not explain brought up to date.

        Args:
            before: memory of the solve before.
            score: ``(M,)`` published scores.
        """
        if self.graph.num_edges == before.graph.num_edges:
            return self
        known = before.graph.num_edges
        is_closure = ~self.graph.is_odometry
        is_closure[self.links] = True
        flagged = int((score > _FLAGGED)[known:][is_closure[known:]].sum())
        changed = (self.trusted[:known] > _GOOD) != (before.trusted > _GOOD)
        turned = int(changed[is_closure[:known].numpy()].sum())
        return replace(self, unexplained=before.unexplained + flagged + turned)

    def seen(self, graph: ViewGraph) -> ViewGraph:
        """The caller's graph, with the links that this memory knows as odometry."""
        if len(self.links) == 0 or graph.num_edges < self.graph.num_edges:
            return graph
        return as_odometry(graph, self.links, self.graph.steps.numpy()[self.links])

    def is_grown_to(self, graph: ViewGraph) -> bool:
        """Whether ``graph`` has grown from this memory's graph."""
        return begins_with(graph, self.graph)

    def thinned_to(self, graph: ViewGraph) -> SlamMemory | None:
        """The memory for a graph that has lost keyframes, as input of :meth:`updated`; None if that is impossible.

        It is impossible if odometry slipped or jumped: once steps are merged, it is no longer known at which of them.
        """
        odometry = self.graph.is_odometry.numpy()
        # As many keyframes may have come since; odometry has merged the steps between those that went.
        if graph.num_nodes >= self.graph.num_nodes and _merged(graph) <= _merged(self.graph):
            return None
        if (self.trusted[odometry] <= _GOOD).any():
            return None
        if self.poses is not None and self.poses.pose.problem.jump is not None:
            return None
        trusted = thinned_out(self.trusted, self.graph, graph, UNKNOWN)
        if trusted is None:
            return None
        share = int((~graph.is_odometry).sum()) / max(int((~odometry).sum()), 1)
        searched, unexplained = (round(min(share, 1.0) * count) for count in (self.searched, self.unexplained))
        told = None if self.warnings is None else without_rows(self.warnings)
        before = replace(self, graph=graph, trusted=trusted, searched=searched, unexplained=unexplained, warnings=told)
        return replace(before, ahead=None, anew=False, update=None, columns=None)

    def updated(
        self, graph: ViewGraph, networks: tuple[SlamCleanNet, SlamFineNet], body_from_world: Tensor
    ) -> UpdateResult:
        """Solve a graph that has grown from this one.

        Args:
            graph: N nodes.
            networks: CleanNet and FineNet; FineNet is applied once.
            body_from_world: ``(N, 4)`` start; it also decides the labels of new closures.
        """
        labelled = Labelled(self.trusted, self.noise, self.calibration, self.poses is not None)
        found = solved_from(labelled, graph, networks, body_from_world)
        estimate = estimate_of(found.published)
        memory = replace(
            self,
            graph=graph,
            trusted=found.trusted,
            noise=found.noise,
            mode=found.mode,
            body_from_world=estimate.body_from_world,
            outlier_score=estimate.outlier_score,
            variance=estimate.variance,
        )
        return UpdateResult(replace(estimate, memory=memory), found.mode)

    def along_odometry(self, graph: ViewGraph, new: Growth) -> Estimate | None:
        """The answer of a graph that has grown by odometry alone; None if the graph has no translations any more.

        Variances grow with the number of steps, not with their turns.

        Args:
            graph: the graph, grown by odometry alone.
            new: its new nodes.
        """
        edge = np.arange(self.graph.num_edges, graph.num_edges)
        poses = None if self.poses is None else self.poses.extended(self.calibrated(graph), new)
        if poses is None and self.poses is not None:
            return None
        steps = graph.steps.numpy()
        orientation = rotations.normalize(rotations.multiply(new.turn, self.body_from_world[new.anchor]))
        passed = torch.from_numpy(new.along(steps[new.edge]) * self.noise.step_variance)
        priors = SlamPriors()
        slipped = torch.from_numpy(steps[edge] * priors.slip_count / (priors.slip_steps + steps[edge]))
        memory = replace(
            self,
            graph=graph,
            trusted=np.append(self.trusted, np.ones(len(edge))),
            body_from_world=torch.cat((self.body_from_world, orientation)),
            outlier_score=torch.cat((self.outlier_score, slipped)),
            variance=torch.cat((self.variance, self.variance[new.anchor] + passed)),
        )
        estimate = Estimate(
            memory.body_from_world,
            memory.outlier_score,
            memory.variance,
            memory,
            self.notes,
            step_variance=self.noise.step_variance,
            is_anew=False,
            restated=torch.from_numpy(self.mode.problem.graph.restated.edge),
        )
        return estimate if poses is None else with_poses(graph, estimate, poses)

    def calibrated(self, graph: ViewGraph) -> ViewGraph:
        """The graph without the systematic errors that were found, if any."""
        return calibrated(graph, self.calibration)


def _merged(graph: ViewGraph) -> float:
    """Number of odometry steps that are part of another edge's."""
    return float((graph.steps[graph.is_odometry] - 1).sum())


def estimate_of(published: Published) -> Estimate:
    """The posterior's answer on the view-graph's nodes and edges."""
    return Estimate(
        published.body_from_world,
        torch.from_numpy(outlier_scores(published.graph, published.outlier_probability, published.of_restated)),
        torch.from_numpy(published.variance),
        warnings=published.warnings,
        step_variance=published.noise.step_variance,
        restated=torch.from_numpy(published.graph.restated.edge),
    )


def with_copies(estimate: Estimate, copies: Copies | None) -> Estimate:
    """The estimate of a graph that states everything once, as that of one that has these copies in addition."""
    memory = estimate.memory
    if isinstance(memory, SlamMemory):
        estimate = replace(estimate, memory=replace(memory, copies=copies))
    return estimate if copies is None else copies.of_all(estimate)


def with_poses(graph: ViewGraph, estimate: Estimate, memory: PoseMemory) -> Estimate:
    """The estimate of rotations alone, with orientations, positions and scores replaced by those of poses.

    Slips of odometry are decided by rotations, jumps of its position by translations.
    """
    poses, goes_on = memory.poses, estimate.memory
    slipped, is_odometry = estimate.outlier_score, graph.is_odometry
    by_both, rotation = (torch.from_numpy(each) for each in (poses.outlier_probability, poses.rotation_probability))
    score = torch.where(is_odometry, slipped + by_both - slipped * by_both, by_both)
    rotation_score = torch.where(is_odometry, slipped, rotation)
    places = Places(
        torch.from_numpy(poses.position),
        torch.from_numpy(poses.position_variance),
        rotation_score,
        torch.from_numpy(poses.precision),
    )
    return replace(
        estimate,
        body_from_world=torch.from_numpy(np.ascontiguousarray(poses.body_from_world)),
        outlier_score=score,
        variance=torch.from_numpy(poses.variance),
        places=places,
        memory=goes_on.with_poses(memory) if isinstance(goes_on, SlamMemory) else None,
        step_variance=memory.step_variance,
    )
