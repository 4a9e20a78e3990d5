"""Translations along the odometry, drawn together as its rotations are.

A segment says  p_b − p_a = Σ W_i t_i , W_i world_from_body where step i begins, which is at its older end: an edge that
is stated the other way round says the same, and errs in the same frame. Orientations within it follow those of its ends
(interpolated) and a Brownian bridge between them, so that with small turns δ of the world frame

    r = Σ W_i t_i − (p_b − p_a)   changes by   − δ_a × A − δ_b × B − (δp_b − δp_a),     A + B = Σ W_i t_i ,

and errs by what the bridge turns: with d(q) what of the way is left at q, less its mean B, the covariance of that is
σ² ∫ (‖d‖² I − d dᵀ) dq where all axes err alike. That is the lever arm of odometry's turns: exact to first order, and
sums alone, so that an edge that several steps were drawn together into keeps theirs (``odometry_route.py``): its lag
goes from A to B, and what its steps' ends spread about their mean adds to d dᵀ.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import torch

from rotavg_ros import rotations
from rotavg_ros.odometry_route import Bend
from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.quaternion_rows import turned_back
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.solver.slam.graph.routes import routes_of, ways_by
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Displacements:
    """Of a closure graph (E edges between K key nodes, N nodes) at some orientations; lengths in metres.

    Attributes:
        displacement: ``(E, 3)`` of target from source in the world, as measured.
        at_source, at_target: ``(E, 3)`` A and B.
        bridge: ``(E, 3, 3)`` ∫ (‖d‖² I − d dᵀ) dq, m² per rad² a step; 0 of edges that are no segments.
        length: ``(E,)`` metres passed.
        lever: ``(N, 3)`` ∫ d dq from the key node above up to each node.
        passed: ``(N,)`` metres passed from the key node above up to each node.
        way: ``(N, 3)`` displacement from the key node above.
    """

    displacement: np.ndarray
    at_source: np.ndarray
    at_target: np.ndarray
    bridge: np.ndarray
    length: np.ndarray
    lever: np.ndarray
    passed: np.ndarray
    way: np.ndarray


class _Steps(NamedTuple):
    """P steps of odometry, segment by segment.

    Attributes:
        first: ``(S + 1,)`` where each segment begins.
        node: ``(P,)`` where each step ends.
        is_forward: ``(P,)`` bool, whether its older end is where it begins, from the segment's start on.
        is_last: ``(P,)`` bool, whether it ends at a key node.
        measured_at: ``(P,)`` where along its segment its older end is.
        share: ``(P,)`` how much of its segment's variance it has.
        variance: ``(P,)`` of its turn, in that of one step.
    """

    first: np.ndarray
    node: np.ndarray
    is_forward: np.ndarray
    is_last: np.ndarray
    measured_at: np.ndarray
    share: np.ndarray
    variance: np.ndarray


@dataclass(frozen=True)
class _Several:
    """Edges (n) that several steps were drawn together into.

    Attributes:
        older, newer: ``(n,)`` their ends.
        newer_from_older: ``(n, 4)`` as measured.
        bend: by the older ends' axes.
    """

    older: np.ndarray
    newer: np.ndarray
    newer_from_older: torch.Tensor
    bend: Bend

    @classmethod
    def of(cls, graph: ViewGraph, edge: np.ndarray, older: np.ndarray, bend: Bend) -> _Several:
        """Of edges ``(n,)`` with their older ends ``(n,)``."""
        source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
        measured = graph.target_from_source[edge].double()
        from_source = source == older
        onwards = torch.where(torch.from_numpy(from_source)[:, None], measured, rotations.inverse(measured))
        newer = np.where(from_source, target, source)
        return cls(older, newer, onwards, bend)

    def at(self, body_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lags ``(n, 3)`` and spreads ``(n, 3, 3)`` by the world's axes, at orientations ``(N, 4)``.

        And how much farther the newer end lies, ``(n, 3)`` metres, since what an edge's turn is off by turns its steps
        by and by: to first order, that × lag.
        """
        world_from_older = rotations.inverse(torch.from_numpy(body_from_world[self.older]))
        world_from_newer = rotations.inverse(torch.from_numpy(body_from_world[self.newer]))
        along = rotations.multiply(world_from_older, rotations.inverse(self.newer_from_older))
        off = rotations.log(rotations.multiply(world_from_newer, rotations.inverse(along))).numpy()
        turn = rotations.to_matrix(world_from_older).numpy()
        lag = np.einsum("nij,nj->ni", turn, self.bend.lag)
        return lag, turn @ self.bend.spread @ np.swapaxes(turn, 1, 2), np.cross(off, lag)


class DrawnSteps:
    """The steps of odometry in the order in which segments take them; what orientations do not change.

    Args:
        graph: of N nodes and M edges.
        translation: ``(M, 3)`` position of the target in the source's frame, metres.
        length: ``(M,)`` metres that each edge's variance goes with.
        drawn: the same graph, drawn together into S segments.
        steps: ``(S,)`` their variance, in that of one step.
        by_turns: ``(M,)`` how much of each edge's variance goes by the squares of its turns.

    Attributes:
        share: ``(M,)`` how much of its segment's variance each edge has; 1 of edges that are part of none.
    """

    def __init__(
        self,
        graph: ViewGraph,
        translation: np.ndarray,
        length: np.ndarray,
        drawn: ClosureGraph,
        steps: np.ndarray,
        by_turns: np.ndarray,
    ) -> None:
        forest, self._num_nodes, self._num_segments = drawn.paths.forest, graph.num_nodes, drawn.num_segments
        node = np.flatnonzero(drawn.paths.hangs_on_odometry)
        segment = drawn.segment_of_edge[forest.parent_edge[node]]
        order = np.lexsort((drawn.paths.level[node], segment))
        self._node, self._segment = node[order], segment[order]
        self._edge, parent = forest.parent_edge[self._node], forest.parent[self._node]
        self._first = np.searchsorted(self._segment, np.arange(self._num_segments))
        self._is_forward = drawn.paths.position[parent] <= drawn.paths.position[self._node]
        self._is_last = drawn.nodes[drawn.target[self._segment]] == self._node
        of_parent = drawn.fraction[parent]
        of_node = np.where(self._is_last, 1.0, drawn.fraction[self._node])
        self.share = np.ones(graph.num_edges)
        self.share[self._edge] = of_node - of_parent
        measured_at = np.where(self._is_forward, of_parent, of_node)
        first, share = np.append(self._first, len(self._node)), of_node - of_parent
        variance = steps[self._segment] * share
        self._steps = _Steps(first, self._node, self._is_forward, self._is_last, measured_at, share, variance)
        older, outside = np.where(self._is_forward, parent, self._node), drawn.view_graph_edge
        from_source = graph.source.numpy()[self._edge]
        stated = ways_by(graph, self._edge, translation[self._edge], older)
        self._measured = older, np.where(from_source == parent, 1.0, -1.0)[:, None] * stated
        several = np.flatnonzero(graph.steps.numpy()[self._edge] > 1)
        self._where_several, self._several = several, None
        if len(several):
            edge = self._edge[several]
            bend = routes_of(graph, edge, older[several]).bent(by_turns[edge])
            self._several = _Several.of(graph, edge, older[several], bend)
        self._outside_is_forward = drawn.is_forward[self._num_segments :, None]
        older = np.where(self._outside_is_forward[:, 0], graph.source.numpy()[outside], graph.target.numpy()[outside])
        self._measured_outside = older, ways_by(graph, outside, translation[outside], older)
        passed = self._so_far(length[self._edge, None])
        self._passed = self._at_nodes(passed)[:, 0]
        self._length = np.concatenate((self._whole(length[self._edge, None])[:, 0], length[outside]))

    def displacements(self, body_from_world: np.ndarray) -> Displacements:
        """At orientations ``(N, 4)``."""
        outside = turned_back(body_from_world, *self._measured_outside)
        count = self._num_segments + len(outside)
        at_source, at_target, bridge = np.empty((count, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
        lever, way = np.zeros((self._num_nodes, 3)), np.zeros((self._num_nodes, 3))
        world = turned_back(body_from_world, *self._measured)
        lag, spread = np.empty((0, 3)), np.empty((0, 3, 3))
        if self._several is not None:
            lag, spread = np.zeros((len(world), 3)), np.zeros((len(world), 3, 3))
            where = self._where_several
            lag[where], spread[where], bent = self._several.at(body_from_world)
            world[where] += np.where(self._is_forward[where, None], bent, -bent)
        _walk(world, lag, spread, self._steps, (at_source, at_target, bridge), (lever, way))
        at_source[self._num_segments :] = np.where(self._outside_is_forward, outside, 0.0)
        at_target[self._num_segments :] = np.where(self._outside_is_forward, 0.0, outside)
        return Displacements(
            at_source + at_target, at_source, at_target, bridge, self._length, lever, self._passed, way
        )

    def up_to_nodes(self, of_edge: np.ndarray) -> np.ndarray:
        """``(N,)`` sums of values ``(M,)`` of odometry's edges from the key node above."""
        return self._at_nodes(self._so_far(of_edge[self._edge, None]))[:, 0]

    def _whole(self, value: np.ndarray) -> np.ndarray:
        """``(S, …)`` sums over segments."""
        if not self._num_segments:
            return np.zeros((0, value.shape[1]))
        return np.asarray(np.add.reduceat(value, self._first, axis=0))

    def _so_far(self, value: np.ndarray) -> np.ndarray:
        """Sums from each step's segment's start, its own included."""
        total = np.cumsum(value, axis=0)
        before = np.concatenate((np.zeros((1, value.shape[1])), total))[self._first]
        return np.asarray(total - before[self._segment])

    def _at_nodes(self, value: np.ndarray) -> np.ndarray:
        """``(N, …)`` sums from the key node above; a key node is its own."""
        out = np.zeros((self._num_nodes, value.shape[1]))
        out[self._node] = np.where(self._is_last[:, None], 0.0, value)
        return out


@compiled
def _walk(
    world: np.ndarray,
    lag: np.ndarray,
    spread: np.ndarray,
    steps: _Steps,
    of_segments: tuple[np.ndarray, np.ndarray, np.ndarray],
    at_nodes: tuple[np.ndarray, np.ndarray],
) -> None:
    """Fill A, B and the bridge of each segment, and the lever and the way up to each node.

    Args:
        world: ``(P, 3)`` metres, the steps.
        lag, spread: ``(P, 3)`` and ``(P, 3, 3)`` of those that are several; empty where none is.
        steps: where they stand.
        of_segments: ``(S, 3)`` A and B, ``(S, 3, 3)`` bridges; longer ones are left as they are from there on.
        at_nodes: ``(N, 3)`` levers and ways; those of key nodes are left as they are.
    """
    at_source, at_target, bridge = of_segments
    lever, way = at_nodes
    passed, arm, d = np.empty(3), np.empty(3), np.empty(3)
    are_several = len(lag) > 0
    for s in range(len(steps.first) - 1):
        begin, end = steps.first[s], steps.first[s + 1]
        own = at_source[s]
        own[:] = 0.0
        for p in range(begin, end):
            for i in range(3):
                own[i] += (1 - steps.measured_at[p]) * world[p, i]
                at_target[s, i] += steps.measured_at[p] * world[p, i]
                if are_several:
                    own[i] -= steps.share[p] * lag[p, i]
                    at_target[s, i] += steps.share[p] * lag[p, i]
        passed[:] = 0.0
        arm[:] = 0.0
        for p in range(begin, end):
            for i in range(3):
                before = passed[i]
                passed[i] += world[p, i]
                # What of the way is left where the step was measured.
                d[i] = own[i] - (passed[i] if steps.is_forward[p] else before)
                if are_several:
                    d[i] += lag[p, i]
                arm[i] += steps.variance[p] * d[i]
            square = d[0] ** 2 + d[1] ** 2 + d[2] ** 2
            for i in range(3):
                bridge[s, i, i] += steps.variance[p] * square
                for j in range(3):
                    bridge[s, i, j] -= steps.variance[p] * d[i] * d[j]
                    if are_several:
                        bridge[s, i, i] += steps.variance[p] * spread[p, j, j]
                        bridge[s, i, j] -= steps.variance[p] * spread[p, i, j]
            if not steps.is_last[p]:
                lever[steps.node[p]] = arm
                way[steps.node[p]] = passed
