"""A drawn pose graph with full ground truth: true poses, and the label and true noise of every edge."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.simulated_odometry import rotation_vectors
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.slam_simulation import simulate_slam_graph
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, ViewGraph

BoolArray = NDArray[np.bool_]
IntArray = NDArray[np.int64]

# Standard deviation assumed for an exact edge, rad per component, so that weights stay finite.
_SMALLEST_SIGMA = np.radians(0.01)
_STUDENT_FREEDOM = 3


@dataclass(frozen=True)
class DrawnGraph:
    """A pose graph and the truth behind it (N keyframes, M edges).

    Attributes:
        graph: what a solver sees.
        body_from_world: ``(N, 4)`` xyzw, true.
        position: ``(N, 3)`` metres, true.
        edge_translation: ``(M, 3)`` measured position of the target in the source frame, metres.
        is_wrong: ``(M,)`` bool, edges that were made wrong: false closures, and odometry that slipped.
        sigma: ``(M,)`` rad, true standard deviation of the rotation vector's components (root mean square over the axes
            where they differ); for false closures and slips, of the noise on top.
        planar: all rotations are yaw.
    """

    graph: ViewGraph
    body_from_world: FloatArray
    position: FloatArray
    edge_translation: FloatArray
    is_wrong: BoolArray
    sigma: FloatArray
    planar: bool

    @property
    def is_closure(self) -> BoolArray:
        """``(M,)`` bool."""
        return np.asarray(~self.graph.is_odometry.numpy())

    @cached_property
    def error(self) -> Rotation:
        """M rotations in the target's frame: measured ∘ true⁻¹."""
        return self.measured * self.true_target_from_source.inv()

    @property
    def is_slip(self) -> BoolArray:
        """``(M,)`` bool: odometry edges that slipped."""
        return self.is_wrong & ~self.is_closure

    @property
    def is_intact(self) -> BoolArray:
        """``(M,)`` bool: neither made wrong (even if right by chance) nor so noisy that it counts as false."""
        return ~(self.is_wrong | self.is_false)

    @property
    def is_false(self) -> BoolArray:
        """``(M,)`` bool: slips, and closures whose noise exceeds 10°."""
        exceeds = np.asarray(self.error.magnitude()) > np.radians(FALSE_CLOSURE_DEG)
        return np.asarray(self.is_slip | (self.is_closure & exceeds))

    @property
    def true_precision(self) -> FloatArray:
        """``(M,)`` rad⁻², finite."""
        return np.asarray(1 / np.maximum(self.sigma, _SMALLEST_SIGMA) ** 2)

    @property
    def ends(self) -> tuple[IntArray, IntArray]:
        """``(M,)`` and ``(M,)``: the earlier and the later end of every edge."""
        source, target = self.graph.source.numpy(), self.graph.target.numpy()
        return np.minimum(source, target), np.maximum(source, target)

    @property
    def measured(self) -> Rotation:
        """M rotations target_from_source."""
        return Rotation.from_quat(self.graph.target_from_source.numpy())

    @property
    def true_target_from_source(self) -> Rotation:
        """M rotations."""
        body_from_world = Rotation.from_quat(self.body_from_world)
        return body_from_world[self.graph.target.numpy()] * body_from_world[self.graph.source.numpy()].inv()

    def to_graph_file(self) -> GraphFile:
        """The graph with ids and ground truth, as stored in files."""
        return GraphFile(
            graph=self.graph,
            node_ids=np.arange(self.graph.num_nodes),
            planar=self.planar,
            edge_translation=self.edge_translation,
            body_from_world_gt=self.body_from_world,
            position_gt=self.position,
        )

    def measuring(self, measured: Rotation) -> DrawnGraph:
        """The same graph with M other measurements target_from_source."""
        rotation = torch.from_numpy(measured.as_quat(canonical=True))
        return replace(self, graph=replace(self.graph, target_from_source=rotation))

    def stating(self, precision: FloatArray) -> DrawnGraph:
        """The same graph with other stated precisions, ``(M,)`` rad⁻², NaN where unknown."""
        return replace(self, graph=replace(self.graph, precision=torch.from_numpy(np.asarray(precision, dtype=float))))

    def with_noise(self, edges: BoolArray, vectors: FloatArray, sigma: FloatArray, stated: float) -> DrawnGraph:
        """Add noise to the measurements of some edges.

        Args:
            edges: ``(M,)`` bool, K of them.
            vectors: ``(K, 3)`` rotation vectors in the target's frame.
            sigma: ``(K,)`` rad, their true standard deviation per component.
            stated: rad, the standard deviation that these edges state.
        """
        noise = np.zeros((self.graph.num_edges, 3))
        noise[edges] = vectors
        true = self.sigma.copy()
        true[edges] = np.hypot(true[edges], sigma)
        precision = self.graph.precision.numpy().copy()
        precision[edges] = stated**-2
        return replace(self.measuring(Rotation.from_rotvec(noise) * self.measured), sigma=true).stating(precision)

    def gaussian(self, edges: BoolArray, sigma: FloatArray, rng: np.random.Generator, stated: float) -> DrawnGraph:
        """Add Gaussian noise to the measurements of some edges; arguments as for :meth:`with_noise`."""
        vectors = rotation_vectors(self.planar, int(edges.sum()), rng) * np.asarray(sigma)[:, None]
        return self.with_noise(edges, vectors, sigma, stated)

    def student(self, edges: BoolArray, scale_deg: float, rng: np.random.Generator) -> DrawnGraph:
        """Add Student's t noise, three degrees of freedom, one tail factor for all components; edges state the scale.

        The true standard deviation is the distribution's.
        """
        count, scale = int(edges.sum()), per_axis(scale_deg, self.planar)
        width = scale / np.sqrt(rng.chisquare(_STUDENT_FREEDOM, count) / _STUDENT_FREEDOM)
        vectors = rotation_vectors(self.planar, count, rng) * width[:, None]
        sigma = np.full(count, scale * np.sqrt(_STUDENT_FREEDOM / (_STUDENT_FREEDOM - 2)))
        return self.with_noise(edges, vectors, sigma, scale)

    def with_wrong_turns(self, edges: IntArray, turns: Rotation) -> DrawnGraph:
        """Let closures measure as if the world had been turned between their ends; their noise stays.

        Args:
            edges: ``(K,)`` indices.
            turns: K rotations of the world from the earlier to the later end.
        """
        source, target = self.graph.source.numpy()[edges], self.graph.target.numpy()[edges]
        forward = np.where(source < target, 1, -1)[:, None]
        body_from_world = Rotation.from_quat(self.body_from_world)
        wrong = Rotation.from_rotvec(turns.as_rotvec() * forward)
        measured = self.measured.as_quat()
        turned = self.error[edges] * body_from_world[target] * wrong * body_from_world[source].inv()
        measured[edges] = turned.as_quat()
        is_wrong = self.is_wrong.copy()
        is_wrong[edges] = True
        return replace(self.measuring(Rotation.from_quat(measured)), is_wrong=is_wrong)

    def selected(self, edges: BoolArray | IntArray) -> DrawnGraph:
        """Some of the edges, in the given order, repeated ones twice."""
        index = np.arange(self.graph.num_edges)[edges]
        return replace(
            self,
            graph=self.graph.select_edges(torch.from_numpy(index)),
            edge_translation=self.edge_translation[index],
            is_wrong=self.is_wrong[index],
            sigma=self.sigma[index],
        )


def per_axis(degrees: float, planar: bool) -> float:
    """Standard deviation of each component, rad, of a rotation whose angle has this root mean square."""
    return float(np.radians(degrees) / np.sqrt(1 if planar else 3))


def simulated(config: SlamSimulationConfig, rng: np.random.Generator) -> DrawnGraph:
    """A simulated run. A bias of the odometry adds its mean square to the variance of its true noise."""
    # The same random numbers without noise on closures show which of them are wrong.
    exact = simulate_slam_graph(replace(config, closure_noise_deg=0.0), deepcopy(rng))
    run = simulate_slam_graph(config, rng)
    planar = config.dimensions == 2
    odometry = np.hypot(per_axis(config.odometry_noise_deg, planar), per_axis(config.odometry_bias_deg, planar))
    closure = per_axis(config.closure_noise_deg, planar)
    graph_file = run.to_graph_file()
    assert graph_file.body_from_world_gt is not None
    return DrawnGraph(
        graph=run.graph,
        body_from_world=graph_file.body_from_world_gt,
        position=run.position,
        edge_translation=run.edge_translation,
        is_wrong=exact.closure_is_false,
        sigma=np.where(run.graph.is_odometry.numpy(), odometry, closure),
        planar=planar,
    )


Change = Callable[[DrawnGraph, np.random.Generator], DrawnGraph]
