"""Measurements of relative poses, drawn from poses that are then exactly the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.simulated_odometry import rotation_vectors
from rotavg_ros.view_graph import EdgeKind, ViewGraph

BoolArray = NDArray[np.bool_]
IndexArray = NDArray[np.int64]


@dataclass(frozen=True)
class Noise:
    """Standard deviation of each component: of the turn about the vertical (planar) or every axis, and of the shift.

    Attributes:
        step_deg, step_m: of one step of odometry.
        closure_deg, closure_m: of a closure.
    """

    step_deg: float
    step_m: float
    closure_deg: float
    closure_m: float

    def of(self, is_odometry: BoolArray) -> FloatArray:
        """``(M, 2)``: rad and metres of every edge."""
        step = np.array([np.radians(self.step_deg), self.step_m])
        closure = np.array([np.radians(self.closure_deg), self.closure_m])
        return np.where(is_odometry[:, None], step, closure)


@dataclass(frozen=True)
class Poses:
    """True poses of N keyframes.

    Attributes:
        body_from_world: ``(N, 4)`` xyzw.
        position: ``(N, 3)`` metres in the world frame.
        planar: motion is in the plane: turns are yaw, and noise has no third dimension.
    """

    body_from_world: FloatArray
    position: FloatArray
    planar: bool

    @cached_property
    def world_from_body(self) -> Rotation:
        """N rotations."""
        return Rotation.from_quat(self.body_from_world).inv()

    def source_from_target(self, source: IndexArray, target: IndexArray) -> tuple[Rotation, FloatArray]:
        """True poses of targets in the frames of their sources: M rotations, and ``(M, 3)`` metres."""
        frame = self.world_from_body[source].inv()
        shift = frame.apply(self.position[target] - self.position[source]).reshape(-1, 3)
        return frame * self.world_from_body[target], shift


@dataclass(frozen=True)
class DrawnPoses:
    """A pose graph and the truth behind it (N keyframes, M edges).

    Attributes:
        graph: what a solver sees, with translations.
        poses: the true poses.
        sigma: ``(M, 2)`` rad and metres, true standard deviation of the components of every edge's noise.
        stated: ``(M, 2)`` likewise, the deviations that the edges state.
        is_wrong: ``(M,)`` bool, closures that were made false.
    """

    graph: ViewGraph
    poses: Poses
    sigma: FloatArray
    stated: FloatArray
    is_wrong: BoolArray

    @property
    def is_closure(self) -> BoolArray:
        """``(M,)`` bool."""
        return np.asarray(~self.graph.is_odometry.numpy())

    def errors(self) -> tuple[FloatArray, FloatArray]:
        """Measurements minus truth: rotation vectors in the target's frame, and metres; ``(M, 3)`` each."""
        rotation, shift = self.poses.source_from_target(self.graph.source.numpy(), self.graph.target.numpy())
        assert self.graph.translation is not None
        turned = Rotation.from_quat(self.graph.target_from_source.numpy()) * rotation
        return np.asarray(turned.as_rotvec()), self.graph.translation.numpy() - shift


def noise_of(planar: bool, sigma: FloatArray, rng: np.random.Generator) -> tuple[Rotation, FloatArray]:
    """Turns and shifts of M edges, Gaussian; in the plane yaw and two components.

    Args:
        sigma: ``(M, 2)`` rad and metres.
    """
    turns = Rotation.from_rotvec(rotation_vectors(planar, len(sigma), rng) * sigma[:, :1])
    return turns, rng.normal(size=(len(sigma), 3)) * sigma[:, 1:] * [1, 1, not planar]


def redrawn(
    topology: ViewGraph, poses: Poses, noise: Noise, rng: np.random.Generator, stated: FloatArray | None = None
) -> DrawnPoses:
    """The edges of a graph, measured once more between given poses.

    Args:
        topology: the graph whose edges' ends, directions and kinds are kept.
        stated: ``(M, 2)`` rad and metres; default: the true deviations.
    """
    sigma = noise.of(topology.is_odometry.numpy())
    stated = sigma if stated is None else stated
    rotation, shift = poses.source_from_target(topology.source.numpy(), topology.target.numpy())
    turns, shifts = noise_of(poses.planar, sigma, rng)
    graph = replace(
        topology,
        target_from_source=torch.from_numpy((turns * rotation.inv()).as_quat(canonical=True)),
        precision=torch.from_numpy(stated[:, 0] ** -2),
        translation=torch.from_numpy(shift + shifts),
    )
    drawn = DrawnPoses(graph, poses, sigma, stated, np.zeros(graph.num_edges, dtype=bool))
    return in_order(drawn, np.arange(graph.num_edges))


def in_order(drawn: DrawnPoses, edges: IndexArray) -> DrawnPoses:
    """Some of the edges as a robot would report them: by their later end, odometry first."""
    later = np.maximum(drawn.graph.source.numpy(), drawn.graph.target.numpy())[edges]
    index = edges[np.lexsort((drawn.graph.kind.numpy()[edges], later))]
    return replace(
        drawn,
        graph=drawn.graph.select_edges(torch.from_numpy(index)),
        sigma=drawn.sigma[index],
        stated=drawn.stated[index],
        is_wrong=drawn.is_wrong[index],
    )


@dataclass(frozen=True)
class Claims:
    """The measurements of K false closures.

    Attributes:
        source, target: ``(K,)`` ends.
        target_from_source: K rotations.
        translation: ``(K, 3)`` position of the target in the source's frame, metres.
    """

    source: IndexArray
    target: IndexArray
    target_from_source: Rotation
    translation: FloatArray

    def reversed(self, which: BoolArray) -> Claims:
        """The same, with some of them reversed."""
        other_way = -self.target_from_source.apply(self.translation).reshape(-1, 3)
        rotation = self.target_from_source.as_quat()
        rotation[which] = self.target_from_source.inv().as_quat()[which]
        return Claims(
            np.where(which, self.target, self.source),
            np.where(which, self.source, self.target),
            Rotation.from_quat(rotation),
            np.where(which[:, None], other_way, self.translation),
        )


def with_closures(drawn: DrawnPoses, claims: Claims) -> DrawnPoses:
    """Add closures, all false, that state the same precision as the first good one."""
    count, graph = len(claims.source), drawn.graph
    first = int(np.flatnonzero(drawn.is_closure)[0])
    assert graph.translation is not None
    joined = ViewGraph.create(
        np.concatenate((graph.source.numpy(), claims.source)),
        np.concatenate((graph.target.numpy(), claims.target)),
        np.concatenate((graph.target_from_source.numpy(), claims.target_from_source.as_quat(canonical=True))),
        num_nodes=graph.num_nodes,
        kind=np.concatenate((graph.kind.numpy(), np.full(count, EdgeKind.LOOP_CLOSURE))),
        precision=np.concatenate((graph.precision.numpy(), np.full(count, drawn.stated[first, 0] ** -2))),
        translation=np.concatenate((graph.translation.numpy(), claims.translation)),
    )
    more = replace(
        drawn,
        graph=joined,
        sigma=np.concatenate((drawn.sigma, np.tile(drawn.sigma[first], (count, 1)))),
        stated=np.concatenate((drawn.stated, np.tile(drawn.stated[first], (count, 1)))),
        is_wrong=np.concatenate((drawn.is_wrong, np.ones(count, dtype=bool))),
    )
    return in_order(more, np.arange(joined.num_edges))
