"""Simulated SLAM pose graphs: a drifting odometry chain and loop closures, many of which may be false.

:func:`simulate_slam_graph` draws one graph for one :class:`SlamSimulationConfig`; :func:`random_slam_config` draws
configs from the wide family that the networks are trained on.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.false_closures import FALSE_CLOSURE_DEG, GROUP_SIZE, SLIP_DEG, random_rotations, random_turns
from rotavg_ros.datasets.graph_file import GraphFile
from rotavg_ros.datasets.slam_config import (
    Precisions,
    SlamSimulationConfig,
    SlamSimulationError,
    random_slam_config,
)
from rotavg_ros.datasets.trajectories import FloatArray, chain_rotations, drive
from rotavg_ros.view_graph import EdgeKind, ViewGraph

__all__ = [
    "Precisions",
    "SimulatedRun",
    "SlamSimulationConfig",
    "SlamSimulationError",
    "random_slam_config",
    "simulate_slam_graph",
]

IndexArray = NDArray[np.int64]
BoolArray = NDArray[np.bool_]

_NEAR_MISS_DEG = (10.0, 30.0)
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
        """The run as a graph with ground truth, as files know it."""
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
    truth = drive(
        config.world,
        config.num_keyframes,
        rng,
        step_m=config.keyframe_distance_m,
        laps=config.laps,
        turn_radius_m=config.turn_radius_m,
        tilt_deg=config.terrain_tilt_deg,
        sway_deg=config.sway_deg,
    )
    world_from_body = Rotation.from_quat(truth.world_from_body)
    odometry = _measure_odometry(config, truth.position, world_from_body, rng)
    closures = _measure_closures(config, truth.position, world_from_body, rng)

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
    odometry_pose = _dead_reckoning(config, odometry, truth.position[0], world_from_body[0])
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


@dataclass(frozen=True)
class _Measurements:
    """Edges of one kind: ends, rotation, position of the target in the source frame, noise level (rad per axis)."""

    ends: tuple[IndexArray, IndexArray]
    target_from_source: FloatArray
    translation: FloatArray
    sigma: FloatArray


def _measure_odometry(
    config: SlamSimulationConfig, position: FloatArray, world_from_body: Rotation, rng: np.random.Generator
) -> _Measurements:
    planar, num_steps = config.dimensions == 2, config.num_keyframes - 1
    sigma = _noise_levels(config, config.odometry_noise_deg, num_steps, rng)
    noise = _rotation_vectors(planar, num_steps, rng) * sigma[:, None]
    if config.odometry_bias_deg > 0:
        bias = _rotation_vectors(planar, 1, rng)
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
        return _Measurements(
            (newer, older), previous_from_next.as_quat(), -previous_from_next.inv().apply(steps), sigma
        )
    return _Measurements((older, newer), previous_from_next.inv().as_quat(), steps, sigma)


def _dead_reckoning(
    config: SlamSimulationConfig, odometry: _Measurements, start: FloatArray, start_world_from_body: Rotation
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


def _measure_closures(
    config: SlamSimulationConfig, position: FloatArray, world_from_body: Rotation, rng: np.random.Generator
) -> _Measurements:
    planar = config.dimensions == 2
    older, newer = _places_seen_again(config, position, rng)
    count = len(older)
    false, group = _choose_false_closures(config, count, rng)
    older, newer = _look_alike_places(config, older, newer, false, group, rng)
    backward = rng.random(count) < config.backward_share
    source, target = np.where(backward, newer, older), np.where(backward, older, newer)

    # What a false closure believes: the world was turned between its ends.
    wrong = np.zeros((count, 4))
    wrong[:, 3] = 1
    is_random, is_near_miss, is_grouped = (false == how for how in (_RANDOM, _NEAR_MISS, _GROUPED))
    wrong[is_random] = random_rotations(int(is_random.sum()), planar, rng, at_least_deg=FALSE_CLOSURE_DEG).as_quat()
    wrong[is_near_miss] = random_turns(int(is_near_miss.sum()), _NEAR_MISS_DEG, planar, rng).as_quat()
    # A group shares one world-frame rotation from the older to the newer end, whichever way the edge runs.
    num_groups = int(group.max(initial=-1)) + 1
    turn = random_rotations(num_groups, planar, rng, at_least_deg=2 * FALSE_CLOSURE_DEG).as_rotvec()
    direction = np.where(backward[is_grouped], -1, 1)[:, None]
    wrong[is_grouped] = Rotation.from_rotvec(turn[group[is_grouped]] * direction).as_quat()

    sigma = _noise_levels(config, config.closure_noise_deg, count, rng)
    noise = Rotation.from_rotvec(_rotation_vectors(planar, count, rng) * sigma[:, None])
    target_from_source = noise * world_from_body[target].inv() * Rotation.from_quat(wrong) * world_from_body[source]
    translation = world_from_body[source].inv().apply(position[target] - position[source])
    spread = rng.normal(size=(count, 3)) * [1, 1, not planar]
    translation = np.where(
        (false != _GOOD)[:, None],
        spread * config.closure_radius_m / 2,
        translation + spread * config.closure_translation_noise_m,
    )
    return _Measurements((source, target), target_from_source.as_quat(), translation, sigma)


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


_GOOD, _RANDOM, _NEAR_MISS, _GROUPED = range(4)


def _choose_false_closures(
    config: SlamSimulationConfig, count: int, rng: np.random.Generator
) -> tuple[IndexArray, IndexArray]:
    """For every closure how it is false and, where grouped, its group (else -1).

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


def _noise_levels(
    config: SlamSimulationConfig, root_mean_square_deg: float, count: int, rng: np.random.Generator
) -> FloatArray:
    """Standard deviation per axis of every edge, radians; the mean square angle is as asked for."""
    axes = 1 if config.dimensions == 2 else 3
    spread = np.exp(config.noise_spread * rng.normal(size=count) - config.noise_spread**2)
    return np.asarray(np.radians(root_mean_square_deg) / np.sqrt(axes) * spread)


def _rotation_vectors(planar: bool, count: int, rng: np.random.Generator) -> FloatArray:
    vectors = rng.normal(size=(count, 3))
    if planar:
        vectors[:, :2] = 0
    return vectors


def _stated_precision(config: SlamSimulationConfig, sigma: FloatArray, factor: float) -> FloatArray:
    if config.precisions is Precisions.MISSING:
        return np.full(len(sigma), np.nan)
    if config.precisions is Precisions.UNIT:
        return np.ones(len(sigma))
    right = 1 / np.maximum(sigma, 1e-6) ** 2
    return right * factor if config.precisions is Precisions.SCALED else right
