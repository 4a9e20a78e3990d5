"""Simulated odometry, and what all simulated measurements share."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import SLIP_DEG, random_turns
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.datasets.simulation.trajectories import chain_rotations

IndexArray = NDArray[np.int64]


@dataclass(frozen=True)
class Measurements:
    """Edges of one kind: ends, rotation, position of the target in the source frame, noise level (rad per axis)."""

    ends: tuple[IndexArray, IndexArray]
    target_from_source: FloatArray
    translation: FloatArray
    sigma: FloatArray


def measure_odometry(
    config: SlamSimulationConfig, position: FloatArray, world_from_body: Rotation, rng: np.random.Generator
) -> Measurements:
    """Steps between consecutive keyframes, drifting and, where asked for, slipping.

    Args:
        position: ``(N, 3)`` metres, true.
        world_from_body: N true orientations.
    """
    planar, num_steps = config.dimensions == 2, config.num_keyframes - 1
    sigma = noise_levels(config, config.odometry_noise_deg, num_steps, rng)
    noise = rotation_vectors(planar, num_steps, rng) * sigma[:, None]
    if config.odometry_bias_deg > 0:
        bias = rotation_vectors(planar, 1, rng)
        noise += np.radians(config.odometry_bias_deg) * bias / np.linalg.norm(bias)
    error = Rotation.from_rotvec(noise)
    slips = rng.permutation(num_steps)[: round(config.slip_share * num_steps)]
    if len(slips):
        turned = error.as_quat()
        turned[slips] = (error[slips] * random_turns(len(slips), SLIP_DEG, planar, rng)).as_quat()
        error = Rotation.from_quat(turned)

    previous_from_next = world_from_body[:-1].inv() * world_from_body[1:] * error
    steps = world_from_body[:-1].inv().apply(np.diff(position, axis=0))
    step_length = np.linalg.norm(steps, axis=1, keepdims=True)
    steps += rng.normal(size=steps.shape) * config.odometry_translation_noise * step_length * [1, 1, not planar]
    older, newer = np.arange(num_steps), np.arange(1, num_steps + 1)
    if config.odometry_backward:
        return Measurements((newer, older), previous_from_next.as_quat(), -previous_from_next.inv().apply(steps), sigma)
    return Measurements((older, newer), previous_from_next.inv().as_quat(), steps, sigma)


def dead_reckoning(
    config: SlamSimulationConfig, odometry: Measurements, start: FloatArray, start_world_from_body: Rotation
) -> tuple[FloatArray, FloatArray]:
    """Odometry's own poses ``(N, 3)``, ``(N, 4)``: the measured steps chained from the true start."""
    rotation, translation = Rotation.from_quat(odometry.target_from_source), odometry.translation
    if config.odometry_backward:
        previous_from_next, steps = rotation, -rotation.apply(translation)
    else:
        previous_from_next, steps = rotation.inv(), translation
    world_from_body = chain_rotations(
        np.concatenate((start_world_from_body.as_quat()[None], previous_from_next.as_quat()))
    )
    moves = Rotation.from_quat(world_from_body[:-1]).apply(steps)
    return np.concatenate((start[None], start + np.cumsum(moves, axis=0))), world_from_body


def noise_levels(
    config: SlamSimulationConfig, root_mean_square_deg: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Standard deviation per axis of every edge, radians, with the given root mean square angle."""
    axes = 1 if config.dimensions == 2 else 3
    spread = np.exp(config.noise_spread * rng.normal(size=count) - config.noise_spread**2)
    return np.asarray(np.radians(root_mean_square_deg) / np.sqrt(axes) * spread)


def rotation_vectors(planar: bool, count: int, rng: np.random.Generator) -> FloatArray:
    """Standard normal rotation vectors ``(count, 3)``, about the vertical where planar."""
    vectors = rng.normal(size=(count, 3))
    if planar:
        vectors[:, :2] = 0
    return vectors
