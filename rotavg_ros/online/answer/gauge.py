"""Continuity between one solution and the next: the gauge, and the start of a warm solve."""

from __future__ import annotations

import math
from collections import deque

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.online import quaternion
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Most closures that are compared where they join two components, and the angle beyond which two disagree.
_MOST_JOINTS, _FAR = 200, math.radians(30)


def is_numbered_by_first_node(component: Tensor) -> bool:
    """Whether labels ``(N,)`` number components in the order of their first nodes, from 0."""
    if component.ndim != 1 or component.dtype != torch.int64:
        return False
    highest = torch.cummax(torch.cat((torch.tensor([-1]), component)), 0).values
    return bool(((component >= 0) & (component <= highest[:-1] + 1)).all())


def component_roots(component: Tensor) -> Tensor:
    """First node of every component, ``(C,)``, from the components' labels ``(N,)`` numbered by first node."""
    nodes = torch.arange(len(component), device=component.device)
    first = torch.full((int(component.max()) + 1,), len(component), device=component.device)
    return first.scatter_reduce(0, component, nodes, "amin")


def fix_gauge(body_from_world: Tensor, component: Tensor, root_body_from_world: Tensor) -> Tensor:
    """Turn the world of every component so that its first node has the given orientation.

    Args:
        body_from_world: ``(N, 4)`` in any gauge.
        component: ``(N,)`` numbered by first node.
        root_body_from_world: ``(C, 4)``.

    Returns:
        ``(N, 4)``, ``R_v R_root⁻¹ A_root``.
    """
    roots = component_roots(component)
    new_from_old_world = rotations.multiply(rotations.inverse(body_from_world[roots]), root_body_from_world)
    return rotations.normalize(rotations.multiply(body_from_world, new_from_old_world[component]))


def joins_components(previous: Tensor, current: Tensor) -> bool:
    """Whether components of the previous labelling ``(n,)`` have become one in the current ``(N,)``, n ≤ N.

    Their relative orientation was arbitrary until now, so the previous solution is no start for the next.
    """
    now = current[component_roots(previous)]
    return len(torch.unique(now)) < len(now)


def joined(body_from_world: Tensor, component: Tensor, graph: ViewGraph) -> Tensor:
    """Orientations of all nodes in one gauge for each component of the graph, where closures have joined some.

    Each component is turned by the one closure to those before it that agrees best with the others. If a user has
    accepted some of these closures, only accepted ones count.

    Args:
        body_from_world: ``(n, 4)`` of the first n nodes, in the gauges of components that were apart.
        component: ``(n,)`` components of these nodes.
        graph: with N ≥ n nodes and odometry, on the CPU.

    Returns:
        ``(N, 4)``; of the components that have become one, the one with the first node stays as it is.
    """
    odometry = graph.is_odometry
    start = extend_along_edges(body_from_world, graph.select_edges(odometry)).clone()
    apart = _components_by_odometry(component, graph)
    is_joint = (apart[graph.source] != apart[graph.target]) & ~odometry & (graph.label != EdgeLabel.REJECTED)
    joints = graph.select_edges(is_joint)
    ends, is_sure = torch.stack((apart[joints.source], apart[joints.target])).numpy(), joints.label.numpy()
    is_sure = is_sure == EdgeLabel.ACCEPTED
    placed = np.zeros(int(apart.max()) + 1, dtype=bool)
    for seed in range(len(placed)):
        placed[seed] = True
        while (reaching := placed[ends[0]] != placed[ends[1]]).any():
            edges = np.flatnonzero(reaching)
            beyond = np.where(placed[ends[0, edges]], ends[1, edges], ends[0, edges])
            nearest = int(np.bincount(beyond).argmax())
            edges = edges[beyond == nearest]
            if is_sure[edges].any():
                edges = edges[is_sure[edges]]
            turn = _most_agreed(_turns(start, joints, edges, placed[ends[0]]))
            is_turned = apart == nearest
            start[is_turned] = rotations.normalize(rotations.multiply(start[is_turned], turn))
            placed[nearest] = True
    return start


def _components_by_odometry(component: Tensor, graph: ViewGraph) -> Tensor:
    """``(N,)`` numbered by first node: the components of the first n nodes, extended by odometry but not closures."""
    from scipy.sparse import coo_array  # only where something joins: a node has no other use for it
    from scipy.sparse.csgraph import connected_components

    to_root = torch.stack((component_roots(component)[component], torch.arange(len(component))))
    odometry = torch.stack((graph.source, graph.target))[:, graph.is_odometry]
    links = torch.cat((to_root, odometry), dim=1).numpy()
    matrix = coo_array((np.ones(links.shape[1]), links), shape=(graph.num_nodes, graph.num_nodes))
    return torch.from_numpy(connected_components(matrix, directed=False)[1].astype(np.int64))


def _turns(start: Tensor, joints: ViewGraph, edges: np.ndarray, source_placed: np.ndarray) -> Tensor:
    """``(n, 4)`` rotations W that make the orientations at the unplaced ends, R → R W, fit the placed ones."""
    chosen = torch.from_numpy(edges[:: len(edges) // _MOST_JOINTS + 1])
    measured, begins = joints.target_from_source[chosen], torch.from_numpy(source_placed)[chosen]
    source, target = start[joints.source[chosen]], start[joints.target[chosen]]
    forward = rotations.multiply(rotations.multiply(rotations.inverse(target), measured), source)
    return torch.where(begins[:, None], forward, rotations.inverse(forward))


def _most_agreed(turns: Tensor) -> Tensor:
    """``(4,)`` the turn with the least sum of angles to the others, each angle capped at :data:`_FAR`."""
    apart = rotations.angle(rotations.multiply(rotations.inverse(turns)[:, None], turns[None]))
    return turns[int(apart.clamp(max=_FAR).sum(dim=1).argmin())]


def extend_along_edges(body_from_world: Tensor, graph: ViewGraph) -> Tensor:
    """Orientations of the first n nodes carried on to all N along the edges, odometry first.

    Args:
        body_from_world: ``(n, 4)``.
        graph: with N ≥ n nodes, on the CPU.

    Returns:
        ``(N, 4)``; a new component starts at identity.
    """
    known = len(body_from_world)
    if known == graph.num_nodes:
        return body_from_world
    neighbours: dict[int, list[tuple[bool, int, Quaternion]]] = {}
    is_new = torch.maximum(graph.source, graph.target) >= known
    edges = graph.select_edges(is_new)
    for source, target, rotation, odometry in zip(
        edges.source.tolist(),
        edges.target.tolist(),
        edges.target_from_source.tolist(),
        edges.is_odometry.tolist(),
        strict=True,
    ):
        neighbours.setdefault(source, []).append((odometry, target, rotation))
        neighbours.setdefault(target, []).append((odometry, source, quaternion.inverse(rotation)))
    placed: dict[int, Quaternion] = {node: tuple(body_from_world[node].tolist()) for node in neighbours if node < known}
    seeds = deque(sorted(placed))
    for node in range(known, graph.num_nodes):
        _flood(placed, seeds, neighbours)
        if node not in placed:
            placed[node] = quaternion.IDENTITY
            seeds.append(node)
    _flood(placed, seeds, neighbours)
    new = [placed[node] for node in range(known, graph.num_nodes)]
    return torch.cat((body_from_world, torch.tensor(new, dtype=torch.float64)))


def _flood(
    placed: dict[int, Quaternion], seeds: deque[int], neighbours: dict[int, list[tuple[bool, int, Quaternion]]]
) -> None:
    """Place everything that the seeds reach, following a loop closure only when no odometry edge is left."""
    later: deque[tuple[int, int, Quaternion]] = deque()
    while seeds or later:
        while seeds:
            node = seeds.popleft()
            for odometry, neighbour, rotation in neighbours.get(node, ()):
                if neighbour in placed:
                    continue
                if odometry:
                    placed[neighbour] = quaternion.multiply(rotation, placed[node])
                    seeds.append(neighbour)
                else:
                    later.append((node, neighbour, rotation))
        if later:
            node, neighbour, rotation = later.popleft()
            if neighbour not in placed:
                placed[neighbour] = quaternion.multiply(rotation, placed[node])
                seeds.append(neighbour)
