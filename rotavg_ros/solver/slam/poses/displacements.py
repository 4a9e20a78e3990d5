"""Translations along the odometry, contracted as its rotations are.

A segment states  p_b − p_a = Σ W_i t_i , with W_i world_from_body at the beginning of step i, its older end. An edge
stated in the other direction says the same and errs in the same frame. Orientations within a segment are interpolated
between its ends, plus a Brownian bridge, so that with small turns δ of the world frame

    r = Σ W_i t_i − (p_b − p_a)   changes by   − δ_a × A − δ_b × B − (δp_b − δp_a),     A + B = Σ W_i t_i ,

and has an error from the bridge's turns: with d(q) the way that is left at q, minus its mean B, the covariance is
σ² ∫ (‖d‖² I − d dᵀ) dq if all axes err alike. This is the lever-arm effect of odometry's turns, exact to first order.
It consists of sums only, so an edge contracted from several steps keeps theirs (``odometry_route.py``): its lag is
moved from A to B, and the spread of its steps' ends about their mean is added to d dᵀ.
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
    """Displacements of a closure graph (E edges between K key nodes, N nodes) at given orientations, in metres.

    Attributes:
        displacement: ``(E, 3)`` of target from source in the world, as measured.
        at_source, at_target: ``(E, 3)`` A and B.
        bridge: ``(E, 3, 3)`` ∫ (‖d‖² I − d dᵀ) dq, m² per rad² a step; 0 for edges that are not segments.
        travelled: ``(E, 2)`` metres, and steps.
        lever: ``(N, 3)`` ∫ d dq from the preceding key node up to each node.
        passed: ``(N, 2)`` metres, and steps, from the preceding key node up to each node.
        way: ``(N, 3)`` displacement from the preceding key node.
    """

    displacement: np.ndarray
    at_source: np.ndarray
    at_target: np.ndarray
    bridge: np.ndarray
    travelled: np.ndarray
    lever: np.ndarray
    passed: np.ndarray
    way: np.ndarray


class _Steps(NamedTuple):
    """P steps of odometry, segment by segment.

    Attributes:
        first: ``(S + 1,)`` index of each segment's first step.
        node: ``(P,)`` node at which each step ends.
        is_forward: ``(P,)`` bool, whether a step begins at its older end, seen from the segment's start.
        is_last: ``(P,)`` bool, whether it ends at a key node.
        measured_at: ``(P,)`` position of its older end along its segment.
        share: ``(P,)`` its share of its segment's variance.
        variance: ``(P,)`` variance of its turn, in units of that of one step.
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
    """Edges (n) that were contracted from several steps.

    Attributes:
        older, newer: ``(n,)`` their ends.
        newer_from_older: ``(n, 4)`` as measured.
        bend: in the older ends' axes.
    """

    older: np.ndarray
    newer: np.ndarray
    newer_from_older: torch.Tensor
    bend: Bend

    @classmethod
    def of(cls, graph: ViewGraph, edge: np.ndarray, older: np.ndarray, bend: Bend) -> _Several:
        """From edges ``(n,)`` with their older ends ``(n,)``."""
        source, target = graph.source.numpy()[edge], graph.target.numpy()[edge]
        measured = graph.target_from_source[edge].double()
        from_source = source == older
        onwards = torch.where(torch.from_numpy(from_source)[:, None], measured, rotations.inverse(measured))
        newer = np.where(from_source, target, source)
        return cls(older, newer, onwards, bend)

    def at(self, body_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Lags ``(n, 3)`` and spreads ``(n, 3, 3)`` in the world's axes, at orientations ``(N, 4)``.

        Also the displacement ``(n, 3)`` metres of the newer end, since the error of an edge's turn is distributed over
        its steps: to first order, the error × lag.
        """
        world_from_older = rotations.inverse(torch.from_numpy(body_from_world[self.older]))
        world_from_newer = rotations.inverse(torch.from_numpy(body_from_world[self.newer]))
        along = rotations.multiply(world_from_older, rotations.inverse(self.newer_from_older))
        off = rotations.log(rotations.multiply(world_from_newer, rotations.inverse(along))).numpy()
        turn = rotations.to_matrix(world_from_older).numpy()
        lag = np.einsum("nij,nj->ni", turn, self.bend.lag)
        return lag, turn @ self.bend.spread @ np.swapaxes(turn, 1, 2), np.cross(off, lag)


class DrawnSteps:
    """The steps of odometry in the order of the segments, with the quantities that do not depend on orientations.

    Args:
        graph: N nodes and M edges.
        translation: ``(M, 3)`` position of the target in the source's frame, metres.
        travelled: ``(M, 2)`` metres, and steps, of each edge.
        drawn: the same graph, contracted into S segments.
        steps: ``(S,)`` variance of the segments, in units of that of one step.
        by_turns: ``(M,)`` part of each edge's variance that is proportional to its squared turns.

    Attributes:
        share: ``(M,)`` each edge's share of its segment's variance; 1 for edges that are part of none.
    """

    def __init__(
        self,
        graph: ViewGraph,
        translation: np.ndarray,
        travelled: np.ndarray,
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
        self._passed = self._at_nodes(self._so_far(travelled[self._edge]))
        self._travelled = np.concatenate((self._whole(travelled[self._edge]), travelled[outside]))

    def displacements(self, body_from_world: np.ndarray) -> Displacements:
        """At orientations ``(N, 4)``."""
        outside = turned_back(body_from_world, *self._measured_outside)
        count = self._num_segments + len(outside)
        at_source, at_target, bridge = np.empty((count, 3)), np.zeros((count, 3)), np.zeros((count, 3, 3))
        lever, way = np.zeros((self._num_nodes, 3)), np.zeros((self._num_nodes, 3))
        world, lag, spread = self._in_world(body_from_world)
        _walk(world, lag, spread, self._steps, (at_source, at_target, bridge), (lever, way))
        at_source[self._num_segments :] = np.where(self._outside_is_forward, outside, 0.0)
        at_target[self._num_segments :] = np.where(self._outside_is_forward, 0.0, outside)
        return Displacements(
            at_source + at_target, at_source, at_target, bridge, self._travelled, lever, self._passed, way
        )

    def squares(self, body_from_world: np.ndarray, way: Displacements) -> np.ndarray:
        """``(N, 3, 3)`` m², ∫ d dᵀ dq from the preceding key node up to each node, at orientations ``(N, 4)``."""
        world, lag, spread = self._in_world(body_from_world)
        passed = self._so_far(world)
        left = way.at_source[self._segment] - np.where(self._is_forward[:, None], passed, passed - world)
        if len(lag):
            left += lag
        square = left[:, :, None] * left[:, None, :]
        if len(spread):
            square += spread
        weighed = self._steps.variance[:, None] * square.reshape(-1, 9)
        return self._at_nodes(self._so_far(weighed)).reshape(-1, 3, 3)

    def _in_world(self, body_from_world: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """``(P, 3)`` metres, the steps at orientations ``(N, 4)``; lags and spreads of contracted ones, or nothing."""
        world = turned_back(body_from_world, *self._measured)
        if self._several is None:
            return world, np.empty((0, 3)), np.empty((0, 3, 3))
        lag, spread = np.zeros((len(world), 3)), np.zeros((len(world), 3, 3))
        where = self._where_several
        lag[where], spread[where], bent = self._several.at(body_from_world)
        world[where] += np.where(self._is_forward[where, None], bent, -bent)
        return world, lag, spread

    def up_to_nodes(self, of_edge: np.ndarray) -> np.ndarray:
        """``(N,)`` sums of values ``(M,)`` of odometry's edges from the preceding key node."""
        return self._at_nodes(self._so_far(of_edge[self._edge, None]))[:, 0]

    def _whole(self, value: np.ndarray) -> np.ndarray:
        """``(S, …)`` sums over segments."""
        if not self._num_segments:
            return np.zeros((0, value.shape[1]))
        return np.asarray(np.add.reduceat(value, self._first, axis=0))

    def _so_far(self, value: np.ndarray) -> np.ndarray:
        """Sums from the start of each step's segment, including the step."""
        total = np.cumsum(value, axis=0)
        before = np.concatenate((np.zeros((1, value.shape[1])), total))[self._first]
        return np.asarray(total - before[self._segment])

    def _at_nodes(self, value: np.ndarray) -> np.ndarray:
        """``(N, …)`` sums from the preceding key node; zero at key nodes."""
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
        lag, spread: ``(P, 3)`` and ``(P, 3, 3)`` of contracted steps; empty if there are none.
        steps: positions of the steps.
        of_segments: ``(S, 3)`` A and B, ``(S, 3, 3)`` bridges; entries beyond S are not changed.
        at_nodes: ``(N, 3)`` levers and ways; those of key nodes are not changed.
    """
    at_source, at_target, bridge = of_segments
    lever, way = at_nodes
    passed, arm, d = np.empty(3), np.empty(3), np.empty(3)
    are_several = len(lag) > 0
    for s in range(len(steps.first) - 1):
        begin, end = steps.first[s], steps.first[s + 1]
        own = at_source[s]
        for i in range(3):
            own[i], passed[i], arm[i] = 0.0, 0.0, 0.0
        for p in range(begin, end):
            for i in range(3):
                own[i] += (1 - steps.measured_at[p]) * world[p, i]
                at_target[s, i] += steps.measured_at[p] * world[p, i]
                if are_several:
                    own[i] -= steps.share[p] * lag[p, i]
                    at_target[s, i] += steps.share[p] * lag[p, i]
        for p in range(begin, end):
            for i in range(3):
                before = passed[i]
                passed[i] += world[p, i]
                # The way that is left where the step was measured.
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
                for i in range(3):
                    lever[steps.node[p], i], way[steps.node[p], i] = arm[i], passed[i]
