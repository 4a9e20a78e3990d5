"""A SLAM graph along a spanning forest: orientations, and how far each closure's ends are apart by odometry."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.pointer_jumping import doublings, follow
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest, accumulate_to_root, compose_orientations
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class OdometryPaths:
    """Of a view-graph of N nodes and M edges, of which F are closures or odometry outside the forest.

    Attributes:
        forest: odometry first.
        orientation: ``(N, 4)`` R⁰, body_from_world composed along it.
        hangs_on_odometry: ``(N,)`` bool, whether a node's parent edge is odometry.
        depth: ``(N,)`` odometry steps from the root.
        level: ``(N,)`` edges from the root.
        chain: ``(N,)`` a number, equal where odometry alone connects two nodes along the forest.
        outside: ``(F,)`` edges, sorted by their ends: the answer must not depend on the order in which they arrived.
        residual: ``(F, 4)`` of these, under R⁰.
        path_steps: ``(F,)`` odometry steps between their ends along the forest; inf where a closure is passed.
    """

    forest: SpanningForest
    orientation: Tensor
    hangs_on_odometry: np.ndarray
    depth: np.ndarray
    level: np.ndarray
    chain: np.ndarray
    outside: np.ndarray
    residual: Tensor
    path_steps: np.ndarray

    @classmethod
    def along(cls, graph: ViewGraph, forest: SpanningForest) -> OdometryPaths:
        """All of a graph on the CPU."""
        num_nodes, parent, parent_edge = graph.num_nodes, forest.parent, forest.parent_edge
        on_tree = np.zeros(graph.num_edges, dtype=bool)
        on_tree[parent_edge[parent_edge >= 0]] = True
        on_tree &= graph.is_odometry.numpy()
        hangs_on_odometry = (parent_edge >= 0) & np.append(on_tree, False)[parent_edge]
        steps = np.append(graph.steps.numpy(), 0.0)[parent_edge]
        nothing = np.empty(0, dtype=np.int64)
        paths = cls(
            forest,
            compose_orientations(forest, graph),
            hangs_on_odometry,
            accumulate_to_root(forest, np.where(hangs_on_odometry, steps, 0.0)),
            accumulate_to_root(forest, np.ones(num_nodes)).astype(np.int64),
            follow(np.where(hangs_on_odometry, parent, np.arange(num_nodes))),
            nothing,
            rotations.identity(0),
            np.empty(0),
        )
        return paths._with_edges(graph, np.flatnonzero(~on_tree))

    def grown(self, graph: ViewGraph) -> OdometryPaths | None:
        """The same of a graph that begins with this one; None where the forest would not simply grow on.

        It does if each new node hangs on an older one by one odometry edge, and the other new edges are closures within
        components.
        """
        num_edges = len(self.outside) + int(self.hangs_on_odometry.sum())
        edge = np.arange(num_edges, graph.num_edges)
        is_odometry = graph.is_odometry.numpy()[num_edges:]
        source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
        new = Growth.of(graph, edge[is_odometry], len(self.depth))
        if new is None:
            return None
        anchor = new.anchor
        orientation = rotations.multiply(new.turn, self.orientation[anchor])
        paths = replace(
            self,
            forest=SpanningForest(
                np.append(self.forest.parent, new.parent),
                np.append(self.forest.parent_edge, new.edge),
                np.append(self.forest.component, self.forest.component[anchor]),
            ),
            orientation=torch.cat((self.orientation, rotations.normalize(orientation))),
            hangs_on_odometry=np.append(self.hangs_on_odometry, np.ones(len(anchor), dtype=bool)),
            depth=np.append(self.depth, self.depth[anchor] + new.along(graph.steps.numpy()[new.edge])),
            level=np.append(
                self.level,
                self.level[anchor] + new.along(np.ones(len(anchor))).astype(np.int64),
            ),
            chain=np.append(self.chain, self.chain[anchor]),
        )
        component, closure = paths.forest.component, ~is_odometry
        if not np.array_equal(component[source[closure]], component[target[closure]]):
            return None
        return paths._with_edges(graph, edge[closure])

    def _with_edges(self, graph: ViewGraph, edges: np.ndarray) -> OdometryPaths:
        """With more edges outside the forest."""
        source, target = graph.source.numpy()[edges], graph.target.numpy()[edges]
        residual = edge_residual(
            self.orientation, graph.target_from_source[edges], graph.source[edges], graph.target[edges]
        )
        path_steps = np.where(
            self.chain[source] == self.chain[target],
            _path_length(self, source, target),
            np.inf,
        )
        outside = np.concatenate((self.outside, edges))
        order = _canonical_order(graph, outside)
        return replace(
            self,
            outside=outside[order],
            residual=torch.cat((self.residual, rotations.canonical(residual)))[torch.from_numpy(order)],
            path_steps=np.concatenate((self.path_steps, path_steps))[order],
        )


@dataclass(frozen=True)
class Growth:
    """New nodes (n), each of which hangs on an older one by one edge of odometry.

    Attributes:
        edge: ``(n,)`` that edge, in the order of nodes.
        parent: ``(n,)`` its other end.
        anchor: ``(n,)`` the known node that the way back leads to.
        turn: ``(n, 4)`` orientations, if anchors' were the identity.
    """

    edge: np.ndarray
    parent: np.ndarray
    anchor: np.ndarray
    turn: Tensor
    _forest: SpanningForest

    @classmethod
    def of(cls, graph: ViewGraph, edge: np.ndarray, num_known: int) -> Growth | None:
        """By new edges ``(n,)`` of odometry; None where nodes after the known ones hang otherwise."""
        source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
        child, parent = np.maximum(source, target), np.minimum(source, target)
        order = np.argsort(child)
        child, parent, edge = child[order], parent[order], edge[order]
        if not np.array_equal(child, np.arange(num_known, graph.num_nodes)):
            return None
        # The new nodes as a graph of their own, rooted at the older ones that they hang on.
        is_rooted = parent < num_known
        root, root_of = np.unique(parent[is_rooted], return_inverse=True)
        above = np.concatenate((np.arange(len(root)), parent - num_known + len(root)))
        above[len(root) :][is_rooted] = root_of
        forest = SpanningForest(above, np.append(np.full(len(root), -1), np.arange(len(child))), above)
        measured = graph.target_from_source[torch.from_numpy(edge)]
        enters = torch.from_numpy(graph.target.numpy()[edge] == child)[:, None]
        local = ViewGraph.create(
            above[len(root) :],
            np.arange(len(root), len(above)),
            torch.where(enters, measured, rotations.inverse(measured)),
            num_nodes=len(above),
        )
        turn = compose_orientations(forest, local)[len(root) :]
        return cls(edge, parent, root[follow(above)[len(root) :]], turn, forest)

    def along(self, value: np.ndarray) -> np.ndarray:
        """Sums of edges' values ``(n,)`` from the anchors on."""
        num_roots = len(self._forest.parent) - len(value)
        return accumulate_to_root(self._forest, np.append(np.zeros(num_roots), value))[num_roots:]


def _canonical_order(graph: ViewGraph, edges: np.ndarray) -> np.ndarray:
    """By their ends, parallels by angle."""
    source, target = graph.source.numpy()[edges], graph.target.numpy()[edges]
    cosine = graph.target_from_source[:, 3].numpy()[edges]
    return np.lexsort((cosine, np.maximum(source, target), np.minimum(source, target)))


def _path_length(paths: OdometryPaths, a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """Length of the ways between nodes of the same tree, by lifting both to their lowest common ancestor."""
    parent, depth, level = paths.forest.parent, paths.depth, paths.level
    jumps = [parent, *(farther for _, farther in doublings(parent))]
    low, high = np.where(level[a] >= level[b], a, b), np.where(level[a] >= level[b], b, a)
    excess = level[low] - level[high]
    for power, jump in enumerate(jumps):
        low = np.where((excess >> power) & 1 == 1, jump[low], low)
    for jump in reversed(jumps):
        apart = jump[low] != jump[high]
        low, high = np.where(apart, jump[low], low), np.where(apart, jump[high], high)
    ancestor = np.where(low == high, low, parent[low])
    return np.asarray(depth[a] + depth[b] - 2 * depth[ancestor])
