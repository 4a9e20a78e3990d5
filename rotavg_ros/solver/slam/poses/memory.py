"""The poses' memory for the next solve of the same graph, grown by a few edges.

New odometry without closures does not change earlier poses: new nodes are placed along it. If there are new closures,
the joint solve begins at the earlier poses, noise and classes.
"""

from __future__ import annotations

from dataclasses import astuple, dataclass, replace

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.odometry_lengths import ways_passed
from rotavg_ros.solver.slam.graph.odometry_paths import Growth
from rotavg_ros.solver.slam.graph.walk import Walk, mean_square
from rotavg_ros.solver.slam.poses.closures import Places
from rotavg_ros.solver.slam.poses.em.start import PoseStart
from rotavg_ros.solver.slam.poses.problem import PoseProblem, crossing
from rotavg_ros.solver.slam.poses.publishing.answer import Poses
from rotavg_ros.solver.slam.poses.row_errors import mean_turn
from rotavg_ros.solver.slam.poses.solved import PoseMode
from rotavg_ros.solver.slam.poses.state import PoseNoise, PoseState
from rotavg_ros.solver.slam.posterior.mode import Mode
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class PoseMemory:
    """Memory of a graph of N nodes and M edges, of which C are closures between key nodes.

    Attributes:
        poses: the published poses.
        alone: ``(N, 4)`` body_from_world by rotations alone, where their next solve continues.
        noise: variances of the joint solve.
        roots: nodes that were held fixed.
        edge: ``(C,)`` the view-graph's edges that are closures.
        places: their classes.
        pose: the joint solve.
        walk: errors of odometry since then.
    """

    poses: Poses
    alone: torch.Tensor
    noise: PoseNoise
    roots: np.ndarray
    edge: np.ndarray
    places: Places
    pose: PoseMode
    walk: Walk

    @classmethod
    def of(cls, pose: PoseMode, poses: Poses) -> PoseMemory:
        """The memory after a solve."""
        drawn, mode = pose.problem.drawn, pose.problem.mode
        alone = drawn.orientations(torch.from_numpy(np.ascontiguousarray(mode.state.correction.T)))
        closures, places = pose.problem.closures, pose.solved.places
        walk = Walk.begin(len(poses.position))
        return cls(poses, alone, pose.state.noise, drawn.nodes[drawn.roots], closures, places, pose, walk)

    @property
    def num_nodes(self) -> int:
        """N."""
        return len(self.poses.position)

    @property
    def num_edges(self) -> int:
        """M."""
        return len(self.poses.precision)

    def problem(self, graph: ViewGraph, translation: np.ndarray, mode: Mode) -> PoseProblem:
        """The problem of a graph that has grown, with the same jumps of odometry."""
        jump, before = None, self.pose.problem.jump
        if before is not None:
            jump = np.zeros(graph.num_edges)
            jump[: len(before)] = before
        return PoseProblem(graph, translation, mode, jump=jump)

    def start_alone(self, graph: ViewGraph) -> torch.Tensor | None:
        """``(N, 4)`` start of rotations alone in a graph that has grown; None if new nodes do not hang on odometry."""
        growth = self._growth(graph)
        return None if growth is None else _laid_on(self.alone, growth)

    def _growth(self, graph: ViewGraph) -> Growth | None:
        new = np.arange(self.num_edges, graph.num_edges)
        return Growth.of(graph, new[graph.is_odometry[new].numpy()], self.num_nodes)

    def start(self, graph: ViewGraph, problem: PoseProblem) -> PoseStart | None:
        """Start of the joint solve of a graph that has grown from this one.

        Where nodes do not hang on odometry (another robot begins) or chains of it have become one, only the noise and
        the classes of places are those of before.

        Args:
            graph: the calibrated graph whose odometry was contracted.
            problem: its problem.
        """
        drawn, closures = problem.drawn, problem.closures
        growth = self._growth(graph)
        grown = None if growth is None else self._grown(graph, growth)
        is_merged = not np.array_equal(drawn.nodes[drawn.roots], self.roots)
        # The verdict on whether the robot keeps a vertical may have changed.
        noise = self.noise if problem.drift_axis is not None else replace(self.noise, tilt=self.noise.turn)
        if grown is None or is_merged:
            return PoseStart.kept(problem, self.kept(self.num_edges), np.array(astuple(noise)))
        orientation, position = grown
        correction = drawn.corrections(orientation).numpy().T
        common = np.zeros((problem.num_runs, 6))
        state = PoseState(np.ascontiguousarray(correction), position[drawn.nodes], common, noise, self.pose.state.shape)
        column = np.full(graph.num_edges, -1)
        column[self.edge] = np.arange(len(self.edge))
        return PoseStart(state, column[closures], self.places)

    def kept(self, num_edges: int) -> np.ndarray:
        """``(R, M)`` float32 input of :meth:`PoseStart.kept` for the first M edges, NaN where nothing is known."""
        known = np.vstack((self.places.chance, self.places.weight, self.places.rotation_weight))
        places = np.full((len(known), num_edges), np.nan, np.float32)
        places[:, self.edge] = known
        return places

    @property
    def crossing(self) -> np.ndarray:
        """``(3, m, k)`` v × in the axes of shifts and turns."""
        problem = self.pose.problem
        return crossing(*problem.bases).reshape(3, problem.shifts, problem.turns)

    @property
    def step_variance(self) -> float:
        """rad², variance of one step of odometry, averaged over components and steps."""
        return mean_turn(self.pose.problem, self.noise)

    def extended(self, graph: ViewGraph, growth: Growth) -> PoseMemory | None:
        """The memory with new nodes placed along odometry; None if that has no translations.

        New odometry beside the chain pulls nothing.
        """
        new = np.arange(self.num_edges, graph.num_edges)
        grown = self._grown(graph, growth)
        if grown is None:
            return None
        orientation, position = grown
        poses, noise = self.poses, self.noise
        assert graph.translation is not None
        steps = graph.steps.numpy()
        own = noise.of_odometry(np.stack((ways_passed(graph.translation[new].numpy()), steps[new]), axis=1))
        attached = growth.edge - self.num_edges
        passed = np.stack((self.step_variance * steps[growth.edge], own[attached]))
        walk = self.walk.along(growth, passed, position)
        added = walk.since(len(self.walk.anchor))
        (turned, moved), crossed = added.variances(self.crossing), mean_square(self.crossing)
        moved += poses.variance[added.anchor] * np.einsum("na,ab,nb->n", added.way, crossed, added.way)
        variance = np.append(poses.variance, poses.variance[added.anchor] + turned)
        position_variance = np.append(poses.position_variance, poses.position_variance[added.anchor] + moved)
        times = np.array((self.pose.problem.mode.state.noise.beside, noise.beside))[:, None].repeat(len(new), axis=1)
        times[:, attached] = 1.0
        # Beside the chain a translation may be unknown.
        precision = np.nan_to_num(1 / (times * (self.step_variance * steps[new], own)), nan=0.0).T
        nothing = np.zeros(len(new))
        alone = _laid_on(self.alone, growth)
        grown_poses = replace(
            poses,
            body_from_world=orientation.numpy(),
            position=position,
            variance=variance,
            position_variance=position_variance,
            outlier_probability=np.append(poses.outlier_probability, nothing),
            rotation_probability=np.append(poses.rotation_probability, nothing),
            precision=np.concatenate((poses.precision, precision)),
        )
        return replace(self, poses=grown_poses, alone=alone, walk=walk)

    def _grown(self, graph: ViewGraph, growth: Growth) -> tuple[torch.Tensor, np.ndarray] | None:
        """Poses of all nodes, ``(N, 4)`` body_from_world and ``(N, 3)``; None unless the growth has translations."""
        edge = torch.from_numpy(growth.edge)
        if graph.translation is None or not bool(torch.isfinite(graph.translation[edge]).all()):
            return None
        orientation = _laid_on(torch.from_numpy(np.ascontiguousarray(self.poses.body_from_world)), growth)
        source = graph.source[edge]
        step = rotations.rotate(rotations.inverse(orientation[source]), graph.translation[edge]).numpy()
        step = np.where((source.numpy() == growth.parent)[:, None], step, -step)
        way = np.stack([growth.along(column) for column in step.T], axis=1)
        position = np.concatenate((self.poses.position, self.poses.position[growth.anchor] + way))
        return orientation, position


def _laid_on(orientation: torch.Tensor, growth: Growth) -> torch.Tensor:
    """Orientations of known nodes, and of new ones along odometry from these."""
    anchor = torch.from_numpy(growth.anchor)
    return torch.cat((orientation, rotations.normalize(rotations.multiply(growth.turn, orientation[anchor]))))
