"""Simulated SLAM pose graphs: a drifting odometry chain and loop closures, many of which may be false.

:func:`simulate_slam_graph` draws one graph for one :class:`SlamSimulationConfig`; :func:`random_slam_config` draws
configs from the wide family that the networks are trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.simulated_closures import measure_closures
from rotavg_ros.datasets.simulation.simulated_odometry import IndexArray, dead_reckoning, measure_odometry
from rotavg_ros.datasets.simulation.slam_config import (
    Precisions,
    SlamSimulationConfig,
    SlamSimulationError,
    random_slam_config,
)
from rotavg_ros.datasets.simulation.trajectories import Way, drive
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, EdgeKind, ViewGraph

__all__ = [
    "Precisions",
    "SimulatedRun",
    "SlamSimulationConfig",
    "SlamSimulationError",
    "random_slam_config",
    "simulate_slam_graph",
]

BoolArray = NDArray[np.bool_]

_START_STAMP_NS = 1_700_000_000_000_000_000


@dataclass(frozen=True)
class SimulatedRun:
    """A simulated pose graph and the truth behind it.

    Edges are in the order in which a robot would report them: by their later end, odometry first.

    Attributes (N keyframes, M edges):
        graph: what the solver sees.
        stamps_ns: ``(N,)`` int64.
        world_from_body: ``(N, 4)`` xyzw, true.
        position: ``(N, 3)`` metres, true.
        odometry_world_from_body: ``(N, 4)`` xyzw, drifting; equals the truth at the first keyframe.
        odometry_position: ``(N, 3)`` metres, drifting.
        edge_translation: ``(M, 3)`` measured position of the target in the source frame, metres.
        edge_noise: ``(M,)`` radians, angle between measured and true relative rotation.
        closure_is_false: ``(M,)`` bool, loop closures with a noise above 10°.
        planar: all rotations are yaw.
    """

    graph: ViewGraph
    stamps_ns: IndexArray
    world_from_body: FloatArray
    position: FloatArray
    odometry_world_from_body: FloatArray
    odometry_position: FloatArray
    edge_translation: FloatArray
    edge_noise: FloatArray
    closure_is_false: BoolArray
    planar: bool

    def to_graph_file(self) -> GraphFile:
        """The run as a graph with ground truth, as stored in files."""
        return GraphFile(
            graph=self.graph,
            node_ids=np.arange(self.graph.num_nodes),
            planar=self.planar,
            edge_translation=self.edge_translation,
            body_from_world_gt=Rotation.from_quat(self.world_from_body).inv().as_quat(canonical=True),
            stamps_ns=self.stamps_ns,
            position_gt=self.position,
        )


def simulate_slam_graph(config: SlamSimulationConfig, rng: np.random.Generator) -> SimulatedRun:
    """Drive through the world, measure odometry and loop closures, make some of them false.

    Raises:
        SlamSimulationError: see :class:`SlamSimulationConfig`.
    """
    way = Way(
        config.world,
        config.num_keyframes,
        step_m=config.keyframe_distance_m,
        laps=config.laps,
        turn_radius_m=config.turn_radius_m,
        tilt_deg=config.terrain_tilt_deg,
        sway_deg=config.sway_deg,
    )
    truth = drive(way, rng)
    world_from_body = Rotation.from_quat(truth.world_from_body)
    odometry = measure_odometry(config, truth.position, world_from_body, rng)
    closures = measure_closures(config, truth.position, world_from_body, rng)

    source, target = (np.concatenate((a, b)) for a, b in zip(odometry.ends, closures.ends, strict=True))
    kind = np.repeat([EdgeKind.ODOMETRY, EdgeKind.LOOP_CLOSURE], [len(odometry.sigma), len(closures.sigma)])
    order = np.lexsort((kind, np.maximum(source, target)))
    source, target, kind = source[order], target[order], kind[order]
    target_from_source = np.concatenate((odometry.target_from_source, closures.target_from_source))[order]
    true_target_from_source = world_from_body[target].inv() * world_from_body[source]
    noise = (Rotation.from_quat(target_from_source) * true_target_from_source.inv()).magnitude()
    precision = np.concatenate(
        (
            _stated_precision(config, odometry.sigma, config.odometry_precision_factor),
            _stated_precision(config, closures.sigma, config.closure_precision_factor),
        )
    )[order]
    odometry_pose = dead_reckoning(config, odometry, truth.position[0], world_from_body[0])
    return SimulatedRun(
        graph=ViewGraph.create(
            source, target, target_from_source, num_nodes=config.num_keyframes, kind=kind, precision=precision
        ),
        stamps_ns=_START_STAMP_NS + np.arange(config.num_keyframes) * round(config.keyframe_period_s * 1e9),
        world_from_body=truth.world_from_body,
        position=truth.position,
        odometry_world_from_body=odometry_pose[1],
        odometry_position=odometry_pose[0],
        edge_translation=np.concatenate((odometry.translation, closures.translation))[order],
        edge_noise=noise,
        closure_is_false=(kind == EdgeKind.LOOP_CLOSURE) & (noise > np.radians(FALSE_CLOSURE_DEG)),
        planar=config.dimensions == 2,
    )


def _stated_precision(config: SlamSimulationConfig, sigma: FloatArray, factor: float) -> FloatArray:
    if config.precisions is Precisions.MISSING:
        return np.full(len(sigma), np.nan)
    if config.precisions is Precisions.UNIT:
        return np.ones(len(sigma))
    right = 1 / np.maximum(sigma, 1e-6) ** 2
    return right * factor if config.precisions is Precisions.SCALED else right
