"""What a solve by the posterior remembers for the next one of the same graph, grown by a few edges.

The labelling that was found, its noise and its bias are where the next solve begins and, but for labels of single
closures, where it ends. The whole search is due again once enough closures have come that this labelling does not
explain: others only make it likelier. Odometry that no closure judges yet says nothing of what was there.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.estimate import Estimate
from rotavg_ros.solver.slam.fine_net.network import SlamFineNet
from rotavg_ros.solver.slam.fine_net.tuning import fine_tuned
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.graph.repeated_edges import first_of_each
from rotavg_ros.solver.slam.network import SlamCleanNet
from rotavg_ros.solver.slam.noise.gyro_bias import without_bias
from rotavg_ros.solver.slam.poses.memory import PoseMemory
from rotavg_ros.solver.slam.posterior.inference import Search
from rotavg_ros.solver.slam.posterior.left_out import relabelled
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.solver.slam.posterior.modes import Published, publish
from rotavg_ros.solver.slam.posterior.priors import SlamPriors
from rotavg_ros.solver.slam.posterior.solve import Drawn
from rotavg_ros.solver.slam.posterior.state import Noise, Others, State
from rotavg_ros.solver.slam.stages import outlier_scores
from rotavg_ros.solver.slam.update.ahead import WholeSolve
from rotavg_ros.solver.slam.update.grown_edges import begins_with, carried_over
from rotavg_ros.view_graph import ViewGraph

# The whole search is due once closures that are not explained are more than this share of those that were searched, or
# new ones more than the second; with any new one where other answers were nearly as likely.
_MAX_UNEXPLAINED, _MAX_GROWTH = 0.05, 0.25
_FLAGGED = 0.5
# In the place of labels that are not known; more than any.
_NEW = 2.0
_GOOD = 0.5


class SearchedOn(NamedTuple):
    """The outcome of an update: the answer, and the labelling; None if only odometry was appended."""

    estimate: Estimate
    mode: Mode | None


@dataclass(frozen=True)
class SlamMemory:
    """Of a graph of N nodes and M edges, C of them closures.

    Attributes:
        graph: the view-graph.
        trusted: ``(M,)`` 1 for good closures and sound odometry, 0 for others; all of a segment have its label.
        noise: of that labelling.
        bias: ``(3,)`` rad per step that was taken out of the odometry; None if none was.
        body_from_world: ``(N, 4)`` that was found, in its own gauge.
        outlier_score: ``(M,)`` that was published.
        variance: ``(N,)`` rad², likewise.
        searched: C when the whole search began.
        is_divided: whether another answer was nearly as likely then.
        unexplained: closures that came since and were flagged, and older ones whose label has changed.
        warnings: about the answer of the whole search; None before somebody has looked.
        poses: where translations are known.
        ahead: the next whole solve, if one is under way.
    """

    graph: ViewGraph
    trusted: np.ndarray
    noise: Noise
    bias: np.ndarray | None
    body_from_world: Tensor
    outlier_score: Tensor
    variance: Tensor
    searched: int
    is_divided: bool = False
    unexplained: int = 0
    warnings: tuple[str, ...] | None = None
    poses: PoseMemory | None = None
    ahead: WholeSolve | None = None

    @classmethod
    def of(
        cls, graph: ViewGraph, bias: np.ndarray | None, mode: Mode, estimate: Estimate, is_divided: bool
    ) -> SlamMemory:
        """After a whole search.

        Args:
            graph: that was solved.
            bias: ``(3,)`` rad per step that was taken out of its odometry, if any.
            mode: the labelling to go on from.
            estimate: what was published, by rotations alone.
            is_divided: whether another answer is nearly as likely.
        """
        problem, state = mode.problem, mode.state
        trusted = problem.graph.edge_values(state.trusted)
        told = estimate.body_from_world, estimate.outlier_score, estimate.variance
        return cls(graph, trusted, state.noise, bias, *told, len(problem.closure), is_divided)

    @property
    def is_due(self) -> bool:
        """Whether the whole search should run again."""
        num_closures = int((~self.graph.is_odometry).sum())
        grown = num_closures > (1 if self.is_divided else 1 + _MAX_GROWTH) * self.searched
        return grown or self.unexplained > _MAX_UNEXPLAINED * self.searched

    def with_poses(self, poses: PoseMemory) -> SlamMemory:
        """The same with what is known of places, by which closures' labels go."""
        trusted = self.trusted.copy()
        trusted[poses.edge] = poses.places.rotation_good > _GOOD
        return replace(self, poses=poses, trusted=trusted)

    def since(self, before: SlamMemory, score: Tensor) -> SlamMemory:
        """The same, with a count of what the labelling does not explain since the whole search.

        Args:
            before: of the solve before.
            score: ``(M,)`` that is published.
        """
        if self.graph.num_edges == before.graph.num_edges:
            return self
        known = before.graph.num_edges
        is_closure = ~self.graph.is_odometry
        flagged = int((score > _FLAGGED)[known:][is_closure[known:]].sum())
        changed = (self.trusted[:known] > _GOOD) != (before.trusted > _GOOD)
        turned = int(changed[is_closure[:known].numpy()].sum())
        return replace(self, unexplained=before.unexplained + flagged + turned)

    def updated(
        self, graph: ViewGraph, networks: tuple[SlamCleanNet, SlamFineNet], body_from_world: Tensor
    ) -> SearchedOn | None:
        """Solve a graph that has grown from this one; None if it has not.

        Args:
            graph: N nodes.
            networks: CleanNet and FineNet, which is applied once.
            body_from_world: ``(N, 4)`` start, where a closure is new.
        """
        if not begins_with(graph, self.graph) or first_of_each(graph) is not None:
            return None
        if (appended := self._appended(graph)) is not None:
            return SearchedOn(appended, None)
        drawn = Drawn.of(graph, networks[0], bias=self.bias)
        problem = drawn.problem
        before = carried_over(self.trusted, problem.graph, _NEW)
        is_new = before == _NEW
        correction = problem.graph.corrections(body_from_world).numpy().T
        common = np.zeros((problem.system(self.noise).num_runs, 3))
        trusted, others = np.minimum(before, 1.0), Others.before_any(len(before))
        start = State(np.ascontiguousarray(correction), common, trusted, self.noise, others)
        start = replace(start, trusted=np.where(is_new, relabelled(problem, start), before))
        search = Search(problem)
        mode = search.polished(start, "update")
        if self.poses is None:  # else places have a say in it
            mode = search.flipped(mode)
        fine = fine_tuned(mode, networks[1], passes=1)
        estimate = estimate_of(publish(problem, [fine]), fine.state.noise)
        memory = replace(
            self,
            graph=graph,
            trusted=problem.graph.edge_values(mode.state.trusted),
            noise=mode.state.noise,
            body_from_world=estimate.body_from_world,
            outlier_score=estimate.outlier_score,
            variance=estimate.variance,
        )
        return SearchedOn(replace(estimate, memory=memory), fine)

    def _appended(self, graph: ViewGraph) -> Estimate | None:
        """The answer if each new node hangs on an older one by one edge of odometry, and nothing else is new.

        Variances grow by the steps passed, whatever odometry does in turns.
        """
        edge = np.arange(self.graph.num_edges, graph.num_edges)
        if not bool(graph.is_odometry[edge].all()):
            return None
        new = Growth.of(graph if self.bias is None else without_bias(graph, self.bias), edge, self.graph.num_nodes)
        if new is None:
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
        return Estimate(
            memory.body_from_world,
            memory.outlier_score,
            memory.variance,
            memory,
            step_variance=self.noise.step_variance,
        )


def estimate_of(published: Published, noise: Noise) -> Estimate:
    """The posterior's answer on the view-graph's nodes and edges; ``noise`` is of the likeliest labelling."""
    return Estimate(
        published.body_from_world,
        torch.from_numpy(outlier_scores(published.graph, published.outlier_probability)),
        torch.from_numpy(published.variance),
        warnings=published.warnings,
        step_variance=noise.step_variance,
    )
