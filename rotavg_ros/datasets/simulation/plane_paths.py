"""Paths of ground robots, ``(num_poses, 2)`` metres: ``step_m`` apart, each place visited about ``laps`` times."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter1d

FloatArray = NDArray[np.floating]


def corridor(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """One bent corridor, up and down."""
    length = num_poses * step_m / laps
    bends = np.cumsum(rng.choice([-np.pi / 2, -np.pi / 4, 0, np.pi / 4, np.pi / 2], size=rng.integers(1, 5)))
    legs = rng.uniform(0.5, 1.5, len(bends))
    legs *= length / legs.sum()
    corners = np.concatenate((np.zeros((1, 2)), np.cumsum(legs[:, None] * direction(bends), axis=0)))
    return walk_along(corners, fold(np.arange(num_poses) * step_m, length))


def building(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """Laps of a rectangular corridor, with short visits to rooms on both sides of it."""
    # Rooms add about 60 % to the length of a lap.
    perimeter = num_poses * step_m / laps / 1.6
    width = perimeter / 2 * rng.uniform(0.5, 0.75)
    size = np.array([width, perimeter / 2 - width])
    corners = np.array([[0, 0], [1, 0], [1, 1], [0, 1], [0, 0]]) * size
    num_doors = rng.integers(4, 13)
    door_at = np.sort(rng.uniform(0, perimeter, num_doors))
    doors = walk_along(corners, door_at)
    depth = perimeter * rng.uniform(0.02, 0.09, num_doors) * rng.choice([-1, 1], num_doors)
    inward = walk_along(corners, np.minimum(door_at + 1e-6 * perimeter, perimeter)) - doors
    inward = inward[:, ::-1] * [-1, 1] / np.maximum(np.linalg.norm(inward, axis=1, keepdims=True), 1e-12)
    rooms = doors + depth[:, None] * inward

    corner_at = np.array([0, size[0], size.sum(), size.sum() + size[0]])
    stop_at = np.concatenate((corner_at, np.repeat(door_at, 3)))
    stops = np.concatenate((corners[:4], np.stack((doors, rooms, doors), axis=1).reshape(-1, 2)))
    order = np.argsort(stop_at, kind="stable")
    num_laps = int(np.ceil(num_poses * step_m / perimeter)) + 1
    visited = rng.random((num_laps, num_doors)) < 0.7
    chosen = np.concatenate((np.ones((num_laps, 4), dtype=bool), np.repeat(visited, 3, axis=1)), axis=1)[:, order]
    waypoints = np.broadcast_to(stops[order], (num_laps, len(order), 2))[chosen]
    return walk_along(waypoints, np.arange(num_poses) * step_m)


def grid(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """A random walk on a lattice, one pose per cell."""
    turns = rng.choice([-1, 0, 0, 0, 1], size=num_poses)
    heading = np.cumsum(turns) % 4
    moves = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])[heading]
    side = max(3, round(np.sqrt(num_poses / laps)))
    return step_m * fold(np.cumsum(moves, axis=0).astype(float) + side // 2, side)


def city(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """Rectangles of city blocks, all through one home crossing."""
    length = num_poses * step_m
    # A rectangle of a × b blocks, a, b ≤ 3, is 8 blocks long on average; four quadrants to choose from.
    block = length / (8 * max(laps, 1) * 4)
    waypoints = [np.zeros(2)]
    driven, arriving = 0.0, np.zeros(2)
    while driven < length + block:
        sides = rng.integers(1, 4, 2) * rng.choice([-1, 1], 2) * block
        along_x, along_y = np.array([sides[0], 0]), np.array([0, sides[1]])
        first, second = (along_x, along_y) if rng.random() < 0.5 else (along_y, along_x)
        if np.dot(first, arriving) < 0:  # no U-turn at home
            first, second = second, first
        waypoints += [first, first + second, second, np.zeros(2)]
        driven += 2 * np.abs(sides).sum()
        arriving = -second
    return walk_along(np.stack(waypoints), np.arange(num_poses) * step_m)


def laps(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """One smooth closed track, again and again."""
    angle = np.linspace(0, 2 * np.pi, 400)
    harmonics = np.arange(2, 6)
    waves = rng.normal(0, 0.25, 4) / harmonics
    radius = 1 + (waves * np.cos(harmonics * angle[:, None] + rng.uniform(0, 2 * np.pi, 4))).sum(1)
    track = radius[:, None] * direction(angle) * [1, rng.uniform(0.4, 1)]
    lap_length = np.linalg.norm(np.diff(track, axis=0), axis=1).sum()
    track *= num_poses * step_m / laps / lap_length
    return walk_along(track, np.arange(num_poses) * step_m % (num_poses * step_m / laps))


def roam(num_poses: int, rng: np.random.Generator, step_m: float, laps: float) -> FloatArray:
    """Aimless driving in a square."""
    heading = np.cumsum(smooth_noise(num_poses, rng.uniform(5, 30), rng) * rng.uniform(0.05, 0.3))
    side = 1.5 * step_m * np.sqrt(num_poses / laps)
    return fold(np.cumsum(step_m * direction(heading), axis=0) + side / 2, side)


def direction(angle: FloatArray) -> FloatArray:
    """Unit vectors ``(..., 2)`` at angles in radians."""
    return np.stack((np.cos(angle), np.sin(angle)), axis=-1)


def fold(distance: FloatArray, length: float) -> FloatArray:
    """Reflect at both ends of [0, length]: back and forth."""
    return np.asarray(length - np.abs(distance % (2 * length) - length))


def walk_along(waypoints: FloatArray, distance: FloatArray) -> FloatArray:
    """Points of a polyline at the given distances from its start."""
    at = np.concatenate(([0.0], np.cumsum(np.linalg.norm(np.diff(waypoints, axis=0), axis=1))))
    return np.stack([np.interp(distance, at, column) for column in waypoints.T], axis=1)


def smooth_noise(length: int, scale: float, rng: np.random.Generator) -> FloatArray:
    """Gaussian noise of unit variance that varies over about ``scale`` samples."""
    padding = int(4 * scale) + 1
    noise: FloatArray = gaussian_filter1d(rng.normal(size=length + 2 * padding), scale)[padding : padding + length]
    noise *= np.sqrt(2 * np.sqrt(np.pi) * scale)
    return noise
