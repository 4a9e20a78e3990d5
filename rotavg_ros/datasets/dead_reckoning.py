"""Poses from chaining relative ones along a tree, as the starting point that pose-graph files carry."""

from __future__ import annotations

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, minimum_spanning_tree

from rotavg_ros.rotations import canonical, identity, inverse, multiply, rotate
from rotavg_ros.view_graph import ViewGraph


def chain_poses(
    graph: ViewGraph, edge_translation: np.ndarray, body_from_world: np.ndarray | None = None
) -> tuple[np.ndarray, np.ndarray]:
    """Poses along a spanning tree that prefers odometry; the first node of every component is at the origin.

    Args:
        edge_translation: ``(M, 3)`` position of the target in the source frame, metres.
        body_from_world: ``(N, 4)`` xyzw, if the orientations are already known; default: chained as well.

    Returns:
        ``(N, 3)`` positions in the world frame, metres, and ``(N, 4)`` world-from-body orientations, w ≥ 0.
    """
    parent, edge = (torch.from_numpy(array) for array in _spanning_tree(graph))
    child = torch.nonzero(edge >= 0).squeeze(1)
    edge = edge[child]
    source_from_target = inverse(graph.target_from_source.cpu()[edge])
    step = torch.as_tensor(edge_translation, dtype=torch.float64).reshape(-1, 3)[edge]
    forward = (graph.target.cpu()[edge] == child)[:, None]
    position, rotation = torch.zeros(graph.num_nodes, 3, dtype=torch.float64), identity(graph.num_nodes)
    if body_from_world is None:
        # Pose of every node in the frame of its parent.
        rotation[child] = torch.where(forward, source_from_target, inverse(source_from_target))
        position[child] = torch.where(forward, step, -rotate(inverse(source_from_target), step))
    else:
        # Position of every node relative to its parent, in the world frame.
        world_from_body = inverse(torch.as_tensor(body_from_world, dtype=torch.float64))
        step = rotate(world_from_body[graph.source.cpu()[edge]], step)
        position[child] = torch.where(forward, step, -step)
    # After each round a node's pose is relative to an ancestor twice as far up, until that is the root.
    ancestor = parent
    while not torch.equal(ancestor, ancestor[ancestor]):
        position = position[ancestor] + rotate(rotation[ancestor], position)
        rotation = multiply(rotation[ancestor], rotation)
        ancestor = ancestor[ancestor]
    return position.numpy(), canonical(rotation if body_from_world is None else world_from_body).numpy()


def _spanning_tree(graph: ViewGraph) -> tuple[np.ndarray, np.ndarray]:
    """Parent of every node (a root is its own) and the edge that joins them (-1 at roots)."""
    num_nodes = graph.num_nodes
    source, target, kind = (array.cpu().numpy() for array in (graph.source, graph.target, graph.kind))
    by_kind = np.argsort(kind, kind="stable")
    pair = np.minimum(source, target)[by_kind] * num_nodes + np.maximum(source, target)[by_kind]
    chosen = by_kind[np.sort(np.unique(pair, return_index=True)[1])]  # one edge per pair, odometry first
    # The weight of an edge is its rank (from 1): the tree takes odometry first and remembers which edge it took.
    shape = (num_nodes + 1, num_nodes + 1)
    ranks = np.arange(1.0, len(chosen) + 1)
    tree = minimum_spanning_tree(coo_array((ranks, (source[chosen], target[chosen])), shape=shape)).tocoo()
    # A node beyond the last, joined to the first node of every component, makes one tree of the forest.
    roots = np.unique(graph.components().cpu().numpy(), return_index=True)[1]
    rows = np.concatenate((tree.row, np.full(len(roots), num_nodes)))
    columns = np.concatenate((tree.col, roots))
    data = np.concatenate((tree.data, np.ones(len(roots))))
    joined = coo_array((data, (rows, columns)), shape=shape).tocsr()
    _, predecessor = breadth_first_order(joined, num_nodes, directed=False)
    parent = predecessor[:num_nodes].astype(np.int64)
    is_root = parent == num_nodes
    parent[is_root] = np.flatnonzero(is_root)
    edge = np.full(num_nodes, -1)
    taken = chosen[tree.data.astype(np.int64) - 1]
    child = np.where(parent[target[taken]] == source[taken], target[taken], source[taken])
    edge[child] = taken
    edge[is_root] = -1
    return parent, edge
