"""Ground-truth trajectories of robots: positions and world-from-body orientations, one row per pose.

Ground robots follow a path in the plane, x forward and z up, which a terrain may tilt; the sphere, the torus and the
parking garage are truly three-dimensional. Every world leads the robot back to where it has been.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation import plane_paths
from rotavg_ros.datasets.simulation.plane_paths import FloatArray, direction, fold, smooth_noise, walk_along
from rotavg_ros.datasets.worlds import PLANAR_WORLDS as PLANAR_WORLDS
from rotavg_ros.datasets.worlds import World as World


@dataclass(frozen=True)
class Trajectory:
    """Poses of the body in the world frame.

    Attributes (N poses):
        position: ``(N, 3)`` metres.
        world_from_body: ``(N, 4)`` xyzw.
    """

    position: FloatArray
    world_from_body: FloatArray


@dataclass(frozen=True)
class Way:
    """How a robot moves through a world.

    Attributes:
        world: the world.
        num_poses: N.
        step_m: distance between consecutive poses.
        laps: about how often every place is visited.
        turn_radius_m: scale on which corners of the path are rounded.
        tilt_deg: typical slope of the terrain (ground worlds).
        sway_deg: standard deviation of a smooth roll, pitch and yaw on top (a hand-held or walking carrier); yaw only
            in a plane world without tilt.
    """

    world: World
    num_poses: int
    step_m: float
    laps: float
    turn_radius_m: float
    tilt_deg: float = 0.0
    sway_deg: float = 0.0


def drive(way: Way, rng: np.random.Generator) -> Trajectory:
    """The poses of a way; ``rng`` is the source of every random choice."""
    is_planar = way.world in PLANAR_WORLDS
    if is_planar:
        path = _PATHS[way.world](way.num_poses, rng, way.step_m, way.laps)
        lane = np.stack([smooth_noise(way.num_poses, 12, rng) for _ in range(2)], axis=1) * 0.2 * way.step_m
        if way.world is World.GRID:
            trajectory = _on_terrain(path, np.zeros(0), 0.0, way.tilt_deg, rng)
        else:
            trajectory = _on_terrain(path, lane, way.turn_radius_m / way.step_m, way.tilt_deg, rng)
    else:
        trajectory = _SPATIAL[way.world](way.num_poses, rng, way.step_m, way.laps)
    if way.sway_deg == 0:
        return trajectory
    sway = np.stack([smooth_noise(way.num_poses, 6, rng) for _ in range(3)], axis=1) * np.radians(way.sway_deg)
    if is_planar and way.tilt_deg == 0:
        sway[:, :2] = 0
    swayed = Rotation.from_quat(trajectory.world_from_body) * Rotation.from_rotvec(sway)
    return Trajectory(trajectory.position, swayed.as_quat(canonical=True))


def chain_rotations(steps: FloatArray) -> FloatArray:
    """Running products ``steps[0] ∘ steps[1] ∘ … ∘ steps[k]`` for every k, shapes ``(N, 4)`` xyzw.

    Prefix products by doubling (Hillis & Steele 1986): log₂ N vectorised multiplications instead of a loop over N.
    """
    products = rotations.normalize(torch.from_numpy(np.array(steps, dtype=np.float64)))
    shift = 1
    while shift < len(products):
        tail = rotations.multiply(products[:-shift], products[shift:])
        products = torch.cat((products[:shift], tail))
        shift *= 2
    return rotations.normalize(products).numpy()


_PATHS = {
    World.CORRIDOR: plane_paths.corridor,
    World.BUILDING: plane_paths.building,
    World.GRID: plane_paths.grid,
    World.CITY: plane_paths.city,
    World.LAPS: plane_paths.laps,
    World.ROAM: plane_paths.roam,
}


def _on_terrain(
    path: FloatArray, lane: FloatArray, smoothing: float, tilt_deg: float, rng: np.random.Generator
) -> Trajectory:
    """Put a path on hills and let the robot face its direction of travel; ``smoothing`` in poses."""
    headings = np.arctan2(*np.diff(path, axis=0, append=2 * path[-1:] - path[-2:-1]).T[::-1])
    if smoothing > 0:
        path = gaussian_filter1d(path, smoothing, axis=0, mode="nearest") + lane
        headings = gaussian_filter1d(np.unwrap(headings), smoothing, mode="nearest")
    position = np.concatenate((path, np.zeros((len(path), 1))), axis=1)
    yaw = np.zeros_like(position)
    yaw[:, 2] = headings
    world_from_body = Rotation.from_rotvec(yaw)
    if tilt_deg > 0:
        extent = max(float(np.ptp(path, axis=0).max()), 1e-9)
        waves = 2 * np.pi / extent * rng.uniform(0.5, 2.5, (6, 1)) * direction(rng.uniform(0, 2 * np.pi, 6))
        phase = path @ waves.T + rng.uniform(0, 2 * np.pi, 6)
        slope_of_wave = np.tan(np.radians(tilt_deg)) / np.sqrt(6 / 2)
        position[:, 2] = (np.sin(phase) * slope_of_wave / np.linalg.norm(waves, axis=1)).sum(1)
        slope = (np.cos(phase) * slope_of_wave) @ (waves / np.linalg.norm(waves, axis=1, keepdims=True))
        steepness = np.linalg.norm(slope, axis=1, keepdims=True)
        # The smallest rotation that takes "up" to the terrain's normal.
        axis = np.stack((slope[:, 1], -slope[:, 0], np.zeros(len(slope))), axis=1) / np.maximum(steepness, 1e-12)
        world_from_body = Rotation.from_rotvec(axis * np.arctan(steepness)) * world_from_body
    return Trajectory(position, world_from_body.as_quat(canonical=True))


def _sphere(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> Trajectory:
    # Rings about one to two steps apart, so that each ring sees the one below it.
    ring_spacing = rng.uniform(0.8, 2.0) * step_m
    radius = np.sqrt(num_poses * step_m * ring_spacing / (4 * np.pi))
    latitude = np.linspace(-0.45, 0.45, num_poses) * np.pi
    # Equal steps: the ring at this latitude has the circumference 2π · radius · cos(latitude).
    longitude = np.cumsum(step_m / (radius * np.cos(latitude)))
    normal = np.stack(
        (np.cos(latitude) * np.cos(longitude), np.cos(latitude) * np.sin(longitude), np.sin(latitude)), axis=1
    )
    return _with_frames(radius * normal, normal)


def _torus(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> Trajectory:
    aspect = rng.uniform(0.2, 0.5)
    coil_spacing = rng.uniform(0.8, 2.0) * step_m
    major = np.sqrt(num_poses * step_m * coil_spacing / (4 * np.pi**2 * aspect))
    minor = aspect * major
    around_tube = np.arange(num_poses) * step_m / minor
    around_axis = around_tube * minor * coil_spacing / (4 * np.pi**2 * minor * major) * 2 * np.pi
    outward = np.stack((np.cos(around_axis), np.sin(around_axis), np.zeros(num_poses)), axis=1)
    normal = np.cos(around_tube)[:, None] * outward
    normal[:, 2] = np.sin(around_tube)
    return _with_frames(major * outward + minor * normal, normal)


def _garage(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> Trajectory:
    floors = max(1.0, laps)
    # Up and down again: every floor is driven twice.
    round_length = num_poses * step_m / (2 * floors)
    width = round_length / 2 * rng.uniform(0.5, 0.8)
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * [width, round_length / 2 - width]
    climbed = fold(np.arange(num_poses) * step_m, floors * round_length)
    path = walk_along(corners, climbed % round_length)
    rounding = round_length / step_m / 40
    path = gaussian_filter1d(path, rounding, axis=0, mode="nearest")
    height = climbed / round_length * np.tan(np.radians(rng.uniform(1, 5))) * round_length
    position = np.concatenate((path, height[:, None]), axis=1)
    headings = np.unwrap(np.arctan2(*np.diff(path, axis=0, append=2 * path[-1:] - path[-2:-1]).T[::-1]))
    headings = gaussian_filter1d(headings, 2, mode="nearest")
    slope = np.gradient(gaussian_filter1d(height, rounding, mode="nearest")) / step_m
    euler = np.stack((headings, -np.arctan(slope)), axis=1)
    return Trajectory(position, Rotation.from_euler("ZY", euler).as_quat(canonical=True))


_SPATIAL = {World.SPHERE: _sphere, World.TORUS: _torus, World.GARAGE: _garage}


def _with_frames(position: FloatArray, up: FloatArray) -> Trajectory:
    """Body frames that look along the path (x) with the given unit vector upward (z)."""
    forward = np.gradient(position, axis=0)
    forward -= (forward * up).sum(1, keepdims=True) * up
    forward /= np.linalg.norm(forward, axis=1, keepdims=True)
    matrix = np.stack((forward, np.cross(up, forward), up), axis=2)
    return Trajectory(position, Rotation.from_matrix(matrix).as_quat(canonical=True))
