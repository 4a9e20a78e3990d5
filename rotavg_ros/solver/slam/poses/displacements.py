"""Translations along the odometry, drawn together as its rotations are.

A segment says  p_b − p_a = Σ W_i t_i , W_i world_from_body where step i was measured. Orientations within it follow
those of its ends (interpolated) and a Brownian bridge between them, so that with small turns δ of the world frame

    r = Σ W_i t_i − (p_b − p_a)   changes by   − δ_a × A − δ_b × B − (δp_b − δp_a),     A + B = Σ W_i t_i ,

and errs by what the bridge turns: with d(q) what of the way is left at q, less its mean B, the covariance of that is
σ² ∫ (‖d‖² I − d dᵀ) dq where all axes err alike. That is the lever arm of odometry's turns: exact to first order, and
sums alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra.odometry_lengths import lengths_passed, typical_length
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
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


class DrawnSteps:
    """The steps of odometry in the order in which segments take them; what orientations do not change.

    Args:
        graph: of N nodes and M edges.
        translation: ``(M, 3)`` position of the target in the source's frame, metres.
        drawn: the same graph, drawn together into S segments.
        steps: ``(S,)`` their variance, in that of one step.

    Attributes:
        share: ``(M,)`` how much of its segment's variance each edge has; 1 of edges that are part of none.
    """

    def __init__(self, graph: ViewGraph, translation: np.ndarray, drawn: ClosureGraph, steps: np.ndarray) -> None:
        forest, self._num_nodes, self._num_segments = drawn.paths.forest, graph.num_nodes, drawn.num_segments
        node = np.flatnonzero(drawn.paths.hangs_on_odometry)
        segment = drawn.segment_of_edge[forest.parent_edge[node]]
        order = np.lexsort((drawn.paths.level[node], segment))
        self._node, self._segment = node[order], segment[order]
        self._edge, parent = forest.parent_edge[self._node], forest.parent[self._node]
        self._first = np.searchsorted(self._segment, np.arange(self._num_segments))
        self._is_forward = graph.source.numpy()[self._edge] == parent
        self._is_last = drawn.nodes[drawn.target[self._segment]] == self._node
        of_parent = drawn.fraction[parent]
        of_node = np.where(self._is_last, 1.0, drawn.fraction[self._node])
        self._variance_steps = (steps[self._segment] * (of_node - of_parent))[:, None]
        self.share = np.ones(graph.num_edges)
        self.share[self._edge] = of_node - of_parent
        # Where along its segment a step's translation was measured.
        self._measured_at = np.where(self._is_forward, of_parent, of_node)[:, None]
        self._source, self._translation = graph.source, torch.from_numpy(translation)
        self._outside = drawn.view_graph_edge
        typical = typical_length(translation, graph.steps.numpy(), graph.is_odometry.numpy())
        length = lengths_passed(translation, graph.steps.numpy(), typical)
        passed = self._so_far(length[self._edge, None])
        self._passed = self._at_nodes(passed)[:, 0]
        self._length = np.concatenate((self._whole(length[self._edge, None])[:, 0], length[self._outside]))

    def displacements(self, body_from_world: Tensor) -> Displacements:
        """At orientations ``(N, 4)``."""
        world_from_body = rotations.inverse(body_from_world)
        world = rotations.rotate(world_from_body.index_select(0, self._source), self._translation).numpy()
        step = np.where(self._is_forward[:, None], world[self._edge], -world[self._edge])
        whole, after = self._whole(step), self._so_far(step)
        at_target = self._whole(self._measured_at * step)
        passed_by = np.where(self._is_forward[:, None], after, after - step)
        d = (whole - at_target)[self._segment] - passed_by
        weighted = self._variance_steps * d
        second = self._whole((weighted[:, :, None] * d[:, None, :]).reshape(len(d), 9)).reshape(-1, 3, 3)
        trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
        outside = world[self._outside]
        nothing = np.zeros((len(outside), 3))
        return Displacements(
            np.concatenate((whole, outside)),
            np.concatenate((whole - at_target, outside)),
            np.concatenate((at_target, nothing)),
            np.concatenate((trace * np.eye(3) - second, np.zeros((len(outside), 3, 3)))),
            self._length,
            self._at_nodes(self._so_far(weighted)),
            self._passed,
            self._at_nodes(after),
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
