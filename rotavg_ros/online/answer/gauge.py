"""Continuity between one solution and the next: the gauge, and the start of a warm solve."""

from __future__ import annotations

from collections import deque

import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.online import quaternion
from rotavg_ros.online.quaternion import Quaternion
from rotavg_ros.view_graph import ViewGraph


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
