"""Makes loop closures false and odometry slip, in graphs with a clean reference and in simulated ones."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from rotavg_ros.datasets.files.graph_file import GraphFile
from rotavg_ros.datasets.simulation.slip_places import CROSSED, SlipRule, slip_places
from rotavg_ros.errors import UserError
from rotavg_ros.view_graph import FALSE_CLOSURE_DEG, EdgeKind

FloatArray = NDArray[np.floating]
BoolArray = NDArray[np.bool_]

# Sizes of groups of false closures that agree with each other.
GROUP_SIZE = (4, 12)
SLIP_DEG = (20.0, 60.0)


class FalseClosureError(UserError):
    """A share outside [0, 1], or a reference that does not fit the graph."""


@dataclass(frozen=True)
class SpoiledGraph:
    """A graph with some measurements replaced by wrong ones.

    Attributes (M edges):
        graph_file: the graph.
        spoiled: ``(M,)`` bool, the edges that were replaced.
        noise: ``(M,)`` radians, angle between the measured and the reference's relative rotation.
    """

    graph_file: GraphFile
    spoiled: BoolArray
    noise: FloatArray

    @property
    def is_outlier(self) -> BoolArray:
        """``(M,)`` bool: noise above 10°."""
        return np.asarray(self.noise > np.radians(FALSE_CLOSURE_DEG))


def replace_closures(
    graph_file: GraphFile,
    body_from_world: FloatArray,
    share: float,
    rng: np.random.Generator,
    *,
    grouped: bool = False,
) -> SpoiledGraph:
    """Replace a share of the loop closures by false ones; on planar graphs they are false in yaw only.

    Args:
        graph_file: the graph, its closures in the order in which they were found.
        body_from_world: ``(N, 4)`` xyzw, a clean reference. Groups are false with respect to it.
        share: of the loop closures, in [0, 1].
        rng: source of every random choice.
        grouped: false closures come in runs of 4–12 (in the file's order) that share one wrong world-frame rotation,
            instead of being random one by one.

    Raises:
        FalseClosureError: a share outside [0, 1], or a reference of another size than the graph.
    """
    _check_share(share, "false closures")
    world_from_body = _reference(graph_file, body_from_world)
    graph = graph_file.graph
    closures = np.flatnonzero(graph.kind.numpy() == EdgeKind.LOOP_CLOSURE)
    count = round(share * len(closures))
    if grouped:
        run_of_closure = random_runs(len(closures), count, rng)
        chosen, run = closures[run_of_closure >= 0], run_of_closure[run_of_closure >= 0]
        turn = random_rotations(
            int(run.max(initial=-1)) + 1, graph_file.planar, rng, at_least_deg=2 * FALSE_CLOSURE_DEG
        )
        source, target = graph.source.numpy()[chosen], graph.target.numpy()[chosen]
        # One rotation of the world from the earlier to the later end, whatever the direction of the edge.
        later_first = (source > target)[:, None]
        wrong = Rotation.from_rotvec(turn.as_rotvec()[run] * np.where(later_first, -1, 1))
        measured = world_from_body[target].inv() * wrong * world_from_body[source]
    else:
        chosen = np.sort(rng.permutation(closures)[:count])
        measured = random_rotations(count, graph_file.planar, rng)
    return _with_measurements(graph_file, world_from_body, chosen, measured)


def insert_slips(
    graph_file: GraphFile,
    body_from_world: FloatArray,
    share: float,
    rng: np.random.Generator,
    *,
    rule: SlipRule = CROSSED,
) -> SpoiledGraph:
    """Let odometry slip: turn a share of its edges by 20–60°, where good loop closures can locate a slip.

    A closure is good if it is within 10° of the reference.

    Args:
        graph_file: the graph; odometry edges connect consecutive nodes.
        body_from_world: ``(N, 4)`` xyzw, a clean reference.
        share: of all odometry edges; fewer slip if fewer qualify.
        rng: source of every random choice.
        rule: which edges qualify.

    Raises:
        FalseClosureError: a share outside [0, 1], or a reference of another size than the graph.
    """
    _check_share(share, "slipping odometry edges")
    world_from_body = _reference(graph_file, body_from_world)
    graph = graph_file.graph
    kind, source, target = graph.kind.numpy(), graph.source.numpy(), graph.target.numpy()
    noise = _noise(graph_file, world_from_body)
    good = (kind == EdgeKind.LOOP_CLOSURE) & (noise <= np.radians(FALSE_CLOSURE_DEG))
    first, last = np.minimum(source, target), np.maximum(source, target)

    locatable = slip_places(first[good], last[good], graph.num_nodes, rule)
    odometry = np.flatnonzero((kind == EdgeKind.ODOMETRY) & (last - first == 1))
    candidates = odometry[locatable[first[odometry]]]
    chosen = np.sort(rng.permutation(candidates)[: round(share * len(odometry))])
    slip = random_turns(len(chosen), SLIP_DEG, graph_file.planar, rng)
    measured = slip * Rotation.from_quat(graph.target_from_source.numpy()[chosen])
    return _with_measurements(graph_file, world_from_body, chosen, measured)


def random_rotations(count: int, planar: bool, rng: np.random.Generator, *, at_least_deg: float = 0.0) -> Rotation:
    """Uniform rotations, about the vertical or in all of SO(3), among those of at least the given angle."""
    if planar:
        return random_turns(count, (at_least_deg, 180.0), True, rng)
    quaternions = rng.normal(size=(count, 4))
    if at_least_deg > 0:
        while (small := Rotation.from_quat(quaternions).magnitude() < np.radians(at_least_deg)).any():
            quaternions[small] = rng.normal(size=(int(small.sum()), 4))
    return Rotation.from_quat(quaternions)


def random_turns(count: int, angle_deg: tuple[float, float], planar: bool, rng: np.random.Generator) -> Rotation:
    """Rotations by a uniform angle from a range, about the vertical (either way) or about a random axis."""
    axis = rng.normal(size=(count, 3))
    if planar:
        axis[:, :2] = 0
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    return Rotation.from_rotvec(axis * np.radians(rng.uniform(*angle_deg, size=(count, 1))))


def _check_share(share: float, what: str) -> None:
    if not 0 <= share <= 1:
        raise FalseClosureError(f"the share of {what} is {share}; it lies in [0, 1]")


def random_runs(length: int, count: int, rng: np.random.Generator) -> NDArray[np.int64]:
    """Which run each of ``length`` items belongs to (-1: none); disjoint runs of 4–12 that cover ``count`` items."""
    sizes: list[int] = []
    while count > 0:
        size = min(int(rng.integers(GROUP_SIZE[0], GROUP_SIZE[1] + 1)), count)
        sizes.append(size)
        count -= size
    # Runs and the items outside them, in random order.
    blocks = np.concatenate((np.full(length - sum(sizes), -1), np.arange(len(sizes))))
    blocks = rng.permutation(blocks)
    return np.repeat(blocks, np.where(blocks >= 0, np.array([*sizes, 1])[blocks], 1))


def _reference(graph_file: GraphFile, body_from_world: FloatArray) -> Rotation:
    """world_from_body of the reference."""
    if np.shape(body_from_world) != (graph_file.graph.num_nodes, 4):
        raise FalseClosureError(
            f"the reference has shape {np.shape(body_from_world)}, the graph needs ({graph_file.graph.num_nodes}, 4)"
        )
    if not np.isfinite(body_from_world).all():
        raise FalseClosureError("the reference lacks the orientation of some nodes; it must be complete")
    return Rotation.from_quat(body_from_world).inv()


def _noise(graph_file: GraphFile, world_from_body: Rotation) -> FloatArray:
    graph = graph_file.graph
    reference = world_from_body[graph.target.numpy()].inv() * world_from_body[graph.source.numpy()]
    return np.asarray((Rotation.from_quat(graph.target_from_source.numpy()) * reference.inv()).magnitude())


def _with_measurements(
    graph_file: GraphFile, world_from_body: Rotation, edges: NDArray[np.int64], measured: Rotation
) -> SpoiledGraph:
    target_from_source = graph_file.graph.target_from_source.numpy().copy()
    target_from_source[edges] = measured.as_quat(canonical=True)
    graph = replace(graph_file.graph, target_from_source=torch.from_numpy(target_from_source))
    spoiled = np.zeros(graph.num_edges, dtype=bool)
    spoiled[edges] = True
    changed = replace(graph_file, graph=graph)
    return SpoiledGraph(changed, spoiled, _noise(changed, world_from_body))
