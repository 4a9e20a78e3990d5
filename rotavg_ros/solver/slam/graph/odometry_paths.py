"""A SLAM graph along a spanning forest: orientations, and distances by odometry between the ends of closures."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.pointer_jumping import follow, lowest_common_ancestors
from rotavg_ros.solver.algebra.quaternion_loops import canonical, inverse, product, unit
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.spanning_forest import (
    SpanningForest,
    accumulate_to_root,
    compose_orientations,
    minimum_spanning_forest,
)
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# What spans more steps is a loop closure.
LOOP_STEPS = 32.0
# Cost of a closure in the forest: larger than that of any number of odometry steps.
_CLOSURE_COST = 1e9
# Number of odometry edges at a node on which a branch hangs.
_FORK = 3


@dataclass(frozen=True)
class OdometryPaths:
    """Paths along a view-graph of N nodes and M edges; F of these are closures, or odometry outside the forest.

    Attributes:
        forest: the forest, which prefers odometry.
        orientation: ``(N, 4)`` R⁰, body_from_world composed along it.
        hangs_on_odometry: ``(N,)`` bool, whether a node's parent edge is odometry.
        depth: ``(N,)`` odometry steps from the root.
        level: ``(N,)`` edges from the root.
        chain: ``(N,)`` the lowest end of each node's chain; equal for nodes that odometry connects along the forest.
        position: ``(N,)`` odometry steps along the chain from that end. Unlike the depth it distinguishes nodes before
            and after the place where the chain hangs on the forest, which may be anywhere.
        outside: ``(F,)`` edges, sorted by their ends, so that the answer does not depend on the order of arrival.
        residual: ``(F, 4)`` their residuals under R⁰.
        path_steps: ``(F,)`` odometry steps between their ends along the forest; inf if a closure is passed.
    """

    forest: SpanningForest
    orientation: Tensor
    hangs_on_odometry: np.ndarray
    depth: np.ndarray
    level: np.ndarray
    chain: np.ndarray
    position: np.ndarray
    outside: np.ndarray
    residual: Tensor
    path_steps: np.ndarray

    @classmethod
    def along(cls, graph: ViewGraph, forest: SpanningForest) -> OdometryPaths:
        """The paths of a graph on the CPU along a forest."""
        num_nodes, parent, parent_edge = graph.num_nodes, forest.parent, forest.parent_edge
        on_tree = np.zeros(graph.num_edges, dtype=bool)
        on_tree[parent_edge[parent_edge >= 0]] = True
        on_tree &= graph.is_odometry.numpy()
        hangs_on_odometry = (parent_edge >= 0) & np.append(on_tree, False)[parent_edge]
        steps = np.append(graph.steps.numpy(), 0.0)[parent_edge]
        orientation = compose_orientations(forest, graph)
        depth = accumulate_to_root(forest, np.where(hangs_on_odometry, steps, 0.0))
        level = accumulate_to_root(forest, np.ones(num_nodes)).astype(np.int64)
        top = follow(np.where(hangs_on_odometry, parent, np.arange(num_nodes)))
        chain = _lowest_ends(parent, top)
        position = _position(parent, depth, level, top, chain)
        outside = np.flatnonzero(~on_tree)
        outside = outside[_canonical_order(graph, outside)]
        source, target = graph.source[outside], graph.target[outside]
        residual = edge_residual(orientation, graph.target_from_source[outside], source, target)
        between = source.numpy(), target.numpy()
        length = _path_length(forest.parent, depth, level, *between)
        path_steps = np.where(chain[between[0]] == chain[between[1]], length, np.inf)
        canonical = rotations.canonical(residual)
        along = depth, level, chain, position
        return cls(forest, orientation, hangs_on_odometry, *along, outside, canonical, path_steps)


def runs_forward(graph: ViewGraph) -> np.ndarray:
    """``(M,)`` bool, whether edges run from the older to the newer end by odometry; for closures, by node numbers."""
    source, target = graph.source.numpy(), graph.target.numpy()
    by_number = source < target
    if _is_chain(graph):
        return by_number
    steps = graph.is_odometry.numpy()
    odometry = graph.select_edges(graph.is_odometry)
    forest = minimum_spanning_forest(odometry, odometry.steps, is_root=odometry_ends(odometry))
    position = OdometryPaths.along(odometry, forest).position
    is_told = steps & (position[source] != position[target])
    return np.where(is_told, position[source] < position[target], by_number)


def odometry_forest(graph: ViewGraph) -> SpanningForest:
    """The forest along which odometry is contracted; of several edges between keyframes, those of fewest steps."""
    usable = graph.label != EdgeLabel.REJECTED
    cost = torch.where(graph.is_odometry, graph.steps, _CLOSURE_COST)
    # A rejected edge may only be used where nothing else connects.
    return minimum_spanning_forest(graph, torch.where(usable, cost, _CLOSURE_COST**2), is_root=odometry_ends(graph))


def runs_along(node: np.ndarray, chain: np.ndarray, position: np.ndarray) -> np.ndarray:
    """``(n,)`` number of each keyframe's run: those of one node and chain without a gap of more than a loop's steps.

    Args:
        node: ``(n,)`` the node that each keyframe is joined to.
        chain, position: ``(n,)`` of keyframes.
    """
    order = np.lexsort((position, chain, node))
    begins = np.ones(len(order), dtype=bool)
    same = (np.diff(node[order]) == 0) & (np.diff(chain[order]) == 0)
    begins[1:] = ~same | (np.diff(position[order]) > LOOP_STEPS)
    run = np.empty(len(order), dtype=np.int64)
    run[order] = np.cumsum(begins) - 1
    return run


def beside_the_chain(graph: ViewGraph) -> np.ndarray:
    """``(M,)`` bool, odometry outside of that forest."""
    beside = graph.is_odometry.numpy().copy()
    if not _is_chain(graph):
        parent_edge = odometry_forest(graph).parent_edge
        beside[parent_edge[parent_edge >= 0]] = False
        return np.asarray(beside)
    return np.zeros(graph.num_edges, dtype=bool)


def _is_chain(graph: ViewGraph) -> bool:
    """Whether odometry leads from no node to two later ones, nor from two to one."""
    steps = graph.is_odometry
    ends = torch.stack((graph.source[steps], graph.target[steps])).numpy()
    return all(np.bincount(end, minlength=1).max() <= 1 for end in (ends.min(axis=0), ends.max(axis=0)))


def near_a_branch(graph: ViewGraph, paths: OdometryPaths) -> np.ndarray:
    """``(F,)`` the branch of odometry from which each closure leads to keyframes near it and each other; else -1.

    A branch is a single node that hangs on the middle of a chain.

    Args:
        graph: the graph.
        paths: its paths.
    """
    near = np.full(len(paths.outside), -1)
    parent_edge = paths.forest.parent_edge
    edges = parent_edge[(parent_edge >= 0) & paths.hangs_on_odometry]
    ends = torch.stack((graph.source, graph.target)).numpy()
    count = np.bincount(ends[:, edges].ravel(), minlength=graph.num_nodes)
    is_branch = np.zeros(graph.num_nodes, dtype=bool)
    for one, other in (ends[:, edges], ends[::-1][:, edges]):
        is_branch[one[(count[one] == 1) & (count[other] >= _FORK)]] = True
    ends = ends[:, paths.outside]
    some = np.flatnonzero((is_branch[ends].sum(axis=0) == 1) & np.isfinite(paths.path_steps))
    if len(some) == 0:
        return near
    branch = np.where(is_branch[ends[0, some]], ends[0, some], ends[1, some])
    other = ends[:, some].sum(axis=0) - branch
    run = runs_along(branch, paths.chain[other], paths.position[other])
    least = np.full(run.max() + 1, np.inf)
    np.minimum.at(least, run, paths.path_steps[some])
    near[some] = np.where(least[run] <= LOOP_STEPS, branch, -1)
    return near


def odometry_ends(graph: ViewGraph) -> np.ndarray:
    """``(N,)`` bool, nodes that at most one odometry edge touches; the forest is rooted there."""
    steps = graph.is_odometry
    touched = torch.cat((graph.source[steps], graph.target[steps]))
    return (torch.bincount(touched, minlength=graph.num_nodes) <= 1).numpy()


@dataclass(frozen=True)
class Growth:
    """n new nodes, each attached to an older one by odometry.

    Attributes:
        edge: ``(n,)`` the edge that attaches each, in the order of the nodes.
        parent: ``(n,)`` its other end.
        anchor: ``(n,)`` the known node at which the way back ends.
        turn: ``(n, 4)`` orientation relative to the anchor: body_from_world if the anchor's is the identity.
    """

    edge: np.ndarray
    parent: np.ndarray
    anchor: np.ndarray
    turn: Tensor
    _num_known: int

    @classmethod
    def of(cls, graph: ViewGraph, edge: np.ndarray, num_known: int) -> Growth | None:
        """From new odometry ``(m,)``; None if it does not attach all nodes from ``num_known`` on to older ones."""
        source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
        child, parent = np.maximum(source, target), np.minimum(source, target)
        # Of several edges to a node, that of fewest steps, as in the forest.
        order = np.lexsort((edge, graph.steps.numpy()[edge], child))
        order = order[np.unique(child[order], return_index=True)[1]]
        order = order[child[order] >= num_known]
        child, parent, edge = child[order], parent[order], edge[order]
        if not np.array_equal(child, np.arange(num_known, graph.num_nodes)):
            return None
        enters = graph.target.numpy()[edge] == child
        anchor, turn = _turns(parent, num_known, graph.target_from_source.numpy()[edge], enters)
        return cls(edge, parent, anchor, torch.from_numpy(turn), num_known)

    def among(self, kept: np.ndarray) -> Growth:
        """The same growth in the graph that has only the edges ``kept`` ``(M',)``, ascending, which include its own."""
        return replace(self, edge=np.searchsorted(kept, self.edge))

    def along(self, value: np.ndarray) -> np.ndarray:
        """``(n,)`` sums of edges' values ``(n,)`` along the way from each node's anchor."""
        return _sums(self.parent, self._num_known, value)


@compiled
def _turns(parent: np.ndarray, known: int, measured: np.ndarray, enters: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """``(n,)`` anchor of each new node, and ``(n, 4)`` its orientation relative to the anchor, w ≥ 0."""
    anchor, turn = np.empty(len(parent), dtype=np.int64), np.empty((len(parent), 4))
    for i in range(len(parent)):
        own = measured[i, 0], measured[i, 1], measured[i, 2], measured[i, 3]
        if not enters[i]:
            own = inverse(own)
        above = parent[i] - known
        anchor[i] = parent[i]
        if above >= 0:
            anchor[i] = anchor[above]
            own = product(own, (turn[above, 0], turn[above, 1], turn[above, 2], turn[above, 3]))
        turn[i, 0], turn[i, 1], turn[i, 2], turn[i, 3] = unit(canonical(own))
    return anchor, turn


@compiled
def _sums(parent: np.ndarray, known: int, value: np.ndarray) -> np.ndarray:
    """``(n,)`` sums of values along the way from each new node's anchor."""
    total = np.empty(len(value))
    for i in range(len(value)):
        above = parent[i] - known
        total[i] = value[i]
        if above >= 0:
            total[i] += total[above]
    return total


def _canonical_order(graph: ViewGraph, edges: np.ndarray) -> np.ndarray:
    """Order of edges by their ends; parallel edges by their angle."""
    source, target = graph.source.numpy()[edges], graph.target.numpy()[edges]
    cosine = graph.target_from_source[:, 3].numpy()[edges]
    return np.lexsort((cosine, np.maximum(source, target), np.minimum(source, target)))


def _lowest_ends(parent: np.ndarray, top: np.ndarray) -> np.ndarray:
    """``(N,)`` lowest end of each node's chain, given the chain's top, where it hangs on the forest."""
    node = np.arange(len(parent))
    hangs = top != node
    is_end = hangs + np.bincount(parent[hangs], minlength=len(node)) <= 1
    lowest = np.full(len(node), len(node))
    np.minimum.at(lowest, top[is_end], node[is_end])
    return np.asarray(lowest[top])


def _position(
    parent: np.ndarray, depth: np.ndarray, level: np.ndarray, top: np.ndarray, lowest: np.ndarray
) -> np.ndarray:
    """``(N,)`` steps from the lowest end of each node's chain; branches of a chain overlap in position."""
    position = depth - depth[top]
    (other,) = np.nonzero(lowest != top)
    if len(other):
        position[other] = _path_length(parent, depth, level, lowest[other], other)
    return np.asarray(position)


def _path_length(parent: np.ndarray, depth: np.ndarray, level: np.ndarray, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Number of steps between nodes a and b of the same tree, by their lowest common ancestor."""
    ancestor = lowest_common_ancestors(parent, level, a, b)
    return np.asarray(depth[a] + depth[b] - 2 * depth[ancestor])
