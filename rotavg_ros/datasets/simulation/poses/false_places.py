"""Closures that join wrong places, on top of the good ones of a drawn graph.

Each kind takes the drawn graph, the number to add and a random generator. For a false closure, the front end believes
that both keyframes show one place, so the measured translation is short although they truly lie elsewhere.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import GROUP_SIZE, random_rotations, random_turns
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.poses.drawn import (
    Claims,
    DrawnPoses,
    IndexArray,
    Poses,
    noise_of,
    with_closures,
)

# Distance of a parallel corridor from the truth, metres, and the error of its rotation, degrees.
WRONG_METRES = (5.0, 50.0)
RIGHT_DEG = 5.0
# Standard deviation per axis of the measured position of a place that looks alike, metres.
_SEEN_METRES = 0.5
# Common turn of a run, and largest noise on top of it, degrees: together less than the limit for a right rotation.
_COMMON_DEG, _MOST_NOISE_DEG = 2.0, 2.9
# Distance within which a symmetric counterpart counts as passed, as a share of the map's smaller dimension.
_PASSED_WITHIN = 0.1
_TRIES = 400
_TOO_SMALL = "hardly two keyframes are that far apart: too small a world for wrong places"

Add = Callable[[DrawnPoses, int, np.random.Generator], DrawnPoses]


def with_share(drawn: DrawnPoses, share: float, add: Add, rng: np.random.Generator) -> DrawnPoses:
    """Add as many false closures as make this share of all closures."""
    good = int((drawn.is_closure & ~drawn.is_wrong).sum())
    count = round(share / (1 - share) * good)
    return add(drawn, count, rng) if count else drawn


def random_places(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> DrawnPoses:
    """Independent random rotations between random keyframes that are at least five metres apart."""
    poses = drawn.poses
    source, target = _random_pairs(poses, count, (WRONG_METRES[0], np.inf), rng)
    claims = Claims(source, target, random_rotations(count, poses.planar, rng), _seen(poses, count, rng))
    return with_closures(drawn, claims.reversed(rng.random(count) < 0.5))


def parallel_corridors(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> DrawnPoses:
    """The rotation is right within 5°, the place is wrong by 5–50 m, independently for each."""
    poses = drawn.poses
    spare = 3 * count + 20
    source, target = _random_pairs(poses, spare, (WRONG_METRES[0] + 2.0, WRONG_METRES[1] - 2.0), rng)
    rotation, shift = poses.source_from_target(source, target)
    seen = _seen(poses, spare, rng)
    errs = np.linalg.norm(seen - shift, axis=1)
    keep = np.flatnonzero((errs > WRONG_METRES[0]) & (errs < WRONG_METRES[1]))[:count]
    turns = random_turns(len(keep), (0.0, RIGHT_DEG), poses.planar, rng)
    claims = Claims(source[keep], target[keep], turns * rotation[keep].inv(), seen[keep])
    return with_closures(drawn, claims.reversed(rng.random(len(keep)) < 0.5))


def parallel_corridors_in_runs(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> DrawnPoses:
    """The same in runs of 4–12 consecutive keyframes that agree on one wrong place, up to the noise of good closures.

    A run joins the two most parallel stretches among 30 random pairs; where a path is nowhere parallel to itself, the
    measured translations grow as the stretches diverge.
    """
    poses = drawn.poses
    sources, targets, shifts, turns = [], [], [], []
    left = count
    while left > 0:
        length = min(int(rng.integers(GROUP_SIZE[0], GROUP_SIZE[1] + 1)), left)
        source, target = _parallel_stretches(poses, length, rng)
        displaced = poses.position[source[0]] - poses.position[target[0]] + _seen(poses, 1, rng)[0]
        turn = random_turns(1, (0.0, _COMMON_DEG), poses.planar, rng).as_rotvec()
        sources.append(source)
        targets.append(target)
        shifts.append(np.tile(displaced, (length, 1)))
        turns.append(np.tile(turn, (length, 1)))
        left -= length
    source, target = np.concatenate(sources), np.concatenate(targets)
    wrong = poses.position[target] + np.concatenate(shifts) - poses.position[source]
    first = int(np.flatnonzero(drawn.is_closure)[0])
    noise = np.tile(drawn.sigma[first], (count, 1))
    turned, shifted = noise_of(poses.planar, noise, rng)
    vector = turned.as_rotvec()
    most = np.radians(_MOST_NOISE_DEG)
    vector *= np.minimum(1, most / np.maximum(np.linalg.norm(vector, axis=1, keepdims=True), 1e-12))
    frame = poses.world_from_body[source].inv()
    turned_world = Rotation.from_rotvec(np.concatenate(turns))
    measured = Rotation.from_rotvec(vector) * poses.world_from_body[target].inv() * turned_world * frame.inv()
    claims = Claims(source, target, measured, frame.apply(wrong).reshape(-1, 3) + shifted)
    return with_closures(drawn, claims.reversed(rng.random(count) < 0.5))


def symmetric_building(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> DrawnPoses:
    """Turned by 90°, 180° or 270° about the vertical: half at the right place, half at the wrong one.

    At the right place, a room looks the same after a turn. The wrong place is where the keyframe would be if the
    building were turned about the middle of its map.
    """
    poses = drawn.poses
    at_place = _turned_at_the_place(drawn, count // 2, rng)
    elsewhere = _turned_about_the_middle(poses, count - count // 2, rng)
    rotation = Rotation.concatenate((at_place.target_from_source, elsewhere.target_from_source))
    claims = Claims(
        np.concatenate((at_place.source, elsewhere.source)),
        np.concatenate((at_place.target, elsewhere.target)),
        rotation,
        np.concatenate((at_place.translation, elsewhere.translation)),
    )
    first = int(np.flatnonzero(drawn.is_closure)[0])
    turns, shifts = noise_of(poses.planar, np.tile(drawn.sigma[first], (count, 1)), rng)
    noisy = Claims(claims.source, claims.target, turns * rotation, claims.translation + shifts)
    return with_closures(drawn, noisy)


def _turned_at_the_place(drawn: DrawnPoses, count: int, rng: np.random.Generator) -> Claims:
    """Between the ends of good closures, which are near each other."""
    good = np.flatnonzero(drawn.is_closure & ~drawn.is_wrong)
    chosen = rng.permutation(np.resize(good, max(count, len(good))))[:count]
    source, target = drawn.graph.source.numpy()[chosen], drawn.graph.target.numpy()[chosen]
    rotation, shift = drawn.poses.source_from_target(source, target)
    up = drawn.poses.world_from_body[target].inv().apply([0.0, 0.0, 1.0]).reshape(-1, 3)
    quarter = np.radians(90.0) * rng.integers(1, 4, (count, 1))
    return Claims(source, target, Rotation.from_rotvec(quarter * up) * rotation.inv(), shift)


def _turned_about_the_middle(poses: Poses, count: int, rng: np.random.Generator) -> Claims:
    """The target is believed to be where it would be if the building were turned about the map's middle."""
    low, high = poses.position.min(axis=0), poses.position.max(axis=0)
    middle, radius = (low + high) / 2, _PASSED_WITHIN * float((high - low)[:2].min())
    tree = KDTree(poses.position)
    target = rng.integers(0, len(poses.position), _TRIES + 20 * count)
    turn = Rotation.from_rotvec(np.radians(90.0) * rng.integers(1, 4, (len(target), 1)) * [0.0, 0.0, 1.0])
    believed = middle + turn.apply(poses.position[target] - middle)
    distance, source = tree.query(believed)
    # Those that the path passes; the nearest ones if it passes too few.
    is_wrong = np.linalg.norm(believed - poses.position[target], axis=1) > WRONG_METRES[0]
    order = np.argsort(np.where(is_wrong & (source != target), np.maximum(distance, radius), np.inf), kind="stable")
    chosen = order[:count]
    source, target, turn = source[chosen], target[chosen], turn[chosen]
    frame = poses.world_from_body[source].inv()
    rotation = frame * turn * poses.world_from_body[target]
    shift = frame.apply(believed[chosen] - poses.position[source]).reshape(-1, 3)
    return Claims(source, target, rotation.inv(), shift)


def _parallel_stretches(poses: Poses, length: int, rng: np.random.Generator) -> tuple[IndexArray, IndexArray]:
    """Two stretches of consecutive keyframes, ``(length,)`` each, passed the same way or the opposite one."""
    last = len(poses.position) - length
    apart = (WRONG_METRES[0] + 4.0, WRONG_METRES[1] - 4.0)
    for _ in range(_TRIES):
        first, other = (np.minimum(end, last)[:, None] for end in _random_pairs(poses, 30, apart, rng))
        ahead = other + np.arange(length)
        source = np.tile(first + np.arange(length), (2, 1))
        target = np.concatenate((ahead, ahead[:, ::-1]))
        gap = poses.position[target] - poses.position[source]
        parting = np.linalg.norm(gap - gap[:, :1], axis=2).max(axis=1)
        # In either direction, the distance of the first pair is the one that all pairs should have.
        distance = np.linalg.norm(gap[:, 0], axis=1)
        parting[(distance < apart[0]) | (distance > apart[1])] = np.inf
        best = int(parting.argmin())
        if np.isfinite(parting[best]):
            return source[best], target[best]
    raise AssertionError(_TOO_SMALL)


def _random_pairs(
    poses: Poses, count: int, apart: tuple[float, float], rng: np.random.Generator
) -> tuple[IndexArray, IndexArray]:
    """Earlier and later keyframes at a distance in a range, metres; ``(count,)`` each."""
    earlier, later = np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64)
    for _ in range(_TRIES):
        ends = np.sort(rng.integers(0, len(poses.position), (4 * count + 64, 2)), axis=1)
        distance = np.linalg.norm(poses.position[ends[:, 0]] - poses.position[ends[:, 1]], axis=1)
        fit = ends[(distance > apart[0]) & (distance < apart[1]) & (ends[:, 1] - ends[:, 0] > 1)]
        earlier, later = np.concatenate((earlier, fit[:, 0])), np.concatenate((later, fit[:, 1]))
        if len(earlier) >= count:
            return earlier[:count], later[:count]
    raise AssertionError(_TOO_SMALL)


def _seen(poses: Poses, count: int, rng: np.random.Generator) -> FloatArray:
    """Measured positions of places that look alike, ``(count, 3)`` metres in the source's frame."""
    return np.asarray(rng.normal(size=(count, 3)) * _SEEN_METRES * [1, 1, not poses.planar])
