"""Simulated loop closures: places that are seen again, and places that only look alike."""

from __future__ import annotations

import numpy as np
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.simulation.false_closures import GROUP_SIZE, random_rotations, random_turns
from rotavg_ros.datasets.simulation.plane_paths import FloatArray
from rotavg_ros.datasets.simulation.simulated_odometry import IndexArray, Measurements, noise_levels, rotation_vectors
from rotavg_ros.datasets.simulation.slam_config import SlamSimulationConfig
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG

_NEAR_MISS_DEG = (10.0, 30.0)
# Keyframes over which a front end sees much the same.
_STRETCH = 20
# Whether and how a closure is false.
_GOOD, _RANDOM, _NEAR_MISS, _GROUPED = range(4)


def measure_closures(
    config: SlamSimulationConfig, position: FloatArray, world_from_body: Rotation, rng: np.random.Generator
) -> Measurements:
    """Loop closures, good and false.

    Args:
        position: ``(N, 3)`` metres, true.
        world_from_body: N true orientations.
    """
    planar = config.dimensions == 2
    older, newer = _places_seen_again(config, position, rng)
    count = len(older)
    false, group = _choose_false_closures(config, count, rng)
    older, newer = _look_alike_places(config, older, newer, false, group, rng)
    backward = rng.random(count) < config.backward_share
    source, target = np.where(backward, newer, older), np.where(backward, older, newer)

    # A false closure measures as if the world had been turned between its ends.
    wrong = np.zeros((count, 4))
    wrong[:, 3] = 1
    is_random, is_near_miss, is_grouped = (false == how for how in (_RANDOM, _NEAR_MISS, _GROUPED))
    wrong[is_random] = random_rotations(int(is_random.sum()), planar, rng, at_least_deg=FALSE_CLOSURE_DEG).as_quat()
    wrong[is_near_miss] = random_turns(int(is_near_miss.sum()), _NEAR_MISS_DEG, planar, rng).as_quat()
    # A group shares one world-frame rotation from the older to the newer end, whatever the direction of the edge.
    num_groups = int(group.max(initial=-1)) + 1
    turn = random_rotations(num_groups, planar, rng, at_least_deg=2 * FALSE_CLOSURE_DEG).as_rotvec()
    direction = np.where(backward[is_grouped], -1, 1)[:, None]
    wrong[is_grouped] = Rotation.from_rotvec(turn[group[is_grouped]] * direction).as_quat()

    sigma = noise_levels(config, config.closure_noise_deg, count, rng)
    own, common = np.sqrt(1 - config.closure_common_share), np.sqrt(config.closure_common_share)
    shared = rotation_vectors(planar, count, rng)[_stretch_pairs(older, newer)] * np.where(backward, -1, 1)[:, None]
    vectors = own * rotation_vectors(planar, count, rng) + common * shared
    noise = Rotation.from_rotvec(vectors * sigma[:, None])
    target_from_source = noise * world_from_body[target].inv() * Rotation.from_quat(wrong) * world_from_body[source]
    translation = world_from_body[source].inv().apply(position[target] - position[source])
    spread = rng.normal(size=(count, 3)) * [1, 1, not planar]
    translation = np.where(
        (false != _GOOD)[:, None],
        spread * config.closure_radius_m / 2,
        translation + spread * config.closure_translation_noise_m,
    )
    return Measurements((source, target), target_from_source.as_quat(), translation, sigma)


def _stretch_pairs(older: IndexArray, newer: IndexArray) -> IndexArray:
    """A number per closure, the same for closures that connect the same two stretches of the path."""
    pairs = np.stack((older // _STRETCH, newer // _STRETCH), axis=1)
    return np.asarray(np.unique(pairs, axis=0, return_inverse=True)[1]).reshape(-1)


def _places_seen_again(
    config: SlamSimulationConfig, position: FloatArray, rng: np.random.Generator
) -> tuple[IndexArray, IndexArray]:
    """Distinct pairs older < newer of keyframes that are near each other, ordered by the newer one."""
    num_nodes = len(position)
    wanted = round(config.closures_per_keyframe * num_nodes)
    num_short = round(config.short_range_share * wanted)
    short_newer = rng.integers(2, num_nodes, 2 * num_short)
    short_older = np.maximum(short_newer - rng.integers(2, 9, 2 * num_short), 0)

    # Most of a keyframe's nearest neighbours are its predecessors and successors; look beyond them.
    in_a_row = int(2 * config.closure_radius_m / config.keyframe_distance_m) + 1
    num_neighbours = min(num_nodes, min(in_a_row, 2 * config.min_closure_gap) + 16)
    anchors = rng.permutation(num_nodes)
    anchors = np.resize(anchors, min(3 * (wanted - num_short), 6 * num_nodes))
    unique_anchors = anchors[: min(len(anchors), num_nodes)]
    _, neighbours = KDTree(position).query(
        position[unique_anchors], k=num_neighbours, distance_upper_bound=config.closure_radius_m
    )
    neighbours = np.resize(neighbours, (len(anchors), num_neighbours))
    apart = (neighbours < num_nodes) & (np.abs(neighbours - anchors[:, None]) >= config.min_closure_gap)
    chosen = np.where(apart, rng.random(neighbours.shape), -1).argmax(1)
    found = apart[np.arange(len(anchors)), chosen]
    far_a, far_b = anchors[found], neighbours[found, chosen[found]]

    def distinct(a: IndexArray, b: IndexArray, count: int) -> IndexArray:
        pairs = np.unique(np.minimum(a, b) * num_nodes + np.maximum(a, b))
        return rng.permutation(pairs)[:count]

    pairs = np.union1d(
        distinct(short_older, short_newer, num_short), distinct(far_a, far_b, wanted - num_short)
    ).astype(np.int64)
    older, newer = np.divmod(pairs, num_nodes)
    order = np.lexsort((older, newer))
    return older[order], newer[order]


def _choose_false_closures(
    config: SlamSimulationConfig, count: int, rng: np.random.Generator
) -> tuple[IndexArray, IndexArray]:
    """For every closure, whether and how it is false, and its group if it has one (else -1).

    Closures are an arrangement of blocks in random order: single ones, and groups of 4–12 that stay together.
    """
    num_false = round(config.false_share * count)
    num_near_miss = round(config.near_miss_share * num_false)
    group_sizes = _group_sizes(round(config.grouped_share * num_false), rng)
    num_random = num_false - num_near_miss - sum(group_sizes)
    block_type = np.repeat(
        [_GOOD, _RANDOM, _NEAR_MISS, _GROUPED], [count - num_false, num_random, num_near_miss, len(group_sizes)]
    )
    block_size = np.concatenate((np.ones(len(block_type) - len(group_sizes), dtype=np.int64), group_sizes))
    group_of_block = np.where(block_type == _GROUPED, np.cumsum(block_type == _GROUPED) - 1, -1)
    order = rng.permutation(len(block_type))
    repeats = block_size[order].astype(np.int64)
    return np.repeat(block_type[order], repeats), np.repeat(group_of_block[order], repeats)


def _group_sizes(total: int, rng: np.random.Generator) -> list[int]:
    """Random group sizes that add up to ``total``; a rest too small for a group of its own is dropped."""
    smallest, largest = GROUP_SIZE
    sizes: list[int] = []
    while total >= smallest:
        size = min(int(rng.integers(smallest, largest + 1)), total)
        sizes.append(size)
        total -= size
    return sizes


def _look_alike_places(
    config: SlamSimulationConfig,
    older: IndexArray,
    newer: IndexArray,
    false: IndexArray,
    group: IndexArray,
    rng: np.random.Generator,
) -> tuple[IndexArray, IndexArray]:
    """Move the ends of false closures to other places; a group becomes two stretches that the robot mixes up."""
    num_nodes = config.num_keyframes
    older, newer = older.copy(), newer.copy()
    single = (false == _RANDOM) | (false == _NEAR_MISS)
    single &= rng.random(len(false)) >= config.in_place_share
    number = int(single.sum())
    first = rng.integers(0, num_nodes, number)
    second = (first + rng.integers(2, num_nodes - 1, number)) % num_nodes
    older[single], newer[single] = np.minimum(first, second), np.maximum(first, second)

    num_groups = int(group.max(initial=-1)) + 1
    stretch = GROUP_SIZE[1]
    if num_groups == 0 or num_nodes < 4 * stretch:
        return older, newer
    moved = rng.random(num_groups) >= config.in_place_share
    first = rng.integers(0, num_nodes - 3 * stretch, num_groups)
    second = rng.integers(first + 2 * stretch, num_nodes - stretch)
    reverse = rng.random(num_groups) < 0.3  # the look-alike place is passed the other way
    member = np.flatnonzero((group >= 0) & moved[group])
    of = group[member]
    # Members of a group follow each other: their rank is the distance to the group's first one.
    starts = np.full(num_groups, len(group))
    np.minimum.at(starts, of, member)
    rank = member - starts[of]
    older[member] = first[of] + np.where(reverse[of], stretch - 1 - rank, rank)
    newer[member] = second[of] + rank
    return older, newer
