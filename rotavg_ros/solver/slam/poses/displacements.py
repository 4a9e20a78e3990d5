"""Translations along the odometry, drawn together as its rotations are.

A segment says  p_b − p_a = Σ W_i t_i , W_i world_from_body where step i was measured. Orientations within it follow
those of its ends (interpolated) and a Brownian bridge between them, so that with small turns δ of the world frame

    r = Σ W_i t_i − (p_b − p_a)   changes by   − δ_a × A − δ_b × B − (δp_b − δp_a),     A + B = Σ W_i t_i ,

and errs by what the bridge turns: with d(q) what of the way is left at q, less its mean B, the covariance of that is
σ² ∫ (‖d‖² I − d dᵀ) dq. That is the lever arm of odometry's turns: exact to first order, and sums alone.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from rotavg_ros.solver.algebra.spanning_forest import accumulate_to_root
from rotavg_ros.solver.slam.graph.closure_graph import ClosureGraph
from rotavg_ros.view_graph import ViewGraph

# A step's variance grows with its length, and is that of this share of a typical one at least: wheels slip on the spot.
_SHORTEST_STEP = 0.05


def rotate_back(body_from_world: np.ndarray, vector: np.ndarray) -> np.ndarray:
    """``(n, 3)`` from the body's frame to the world's; orientations are ``(4, n)``."""
    imaginary, real = -body_from_world[:3].T, body_from_world[3][:, None]
    twice = 2 * np.cross(imaginary, vector)
    return np.asarray(vector + real * twice + np.cross(imaginary, twice))


def typical_length(graph: ViewGraph, translation: np.ndarray) -> float:
    """Median length of the steps of odometry that go anywhere, metres; 1 where none does."""
    is_odometry = graph.is_odometry.numpy()
    length = np.linalg.norm(translation[is_odometry], axis=1) / graph.steps.numpy()[is_odometry]
    moving = length[length > 0]
    return float(np.median(moving)) if len(moving) else 1.0


def lengths_passed(graph: ViewGraph, translation: np.ndarray) -> np.ndarray:
    """``(M,)`` metres that each edge's variance goes with."""
    shortest = _SHORTEST_STEP * typical_length(graph, translation)
    return np.asarray(np.maximum(np.linalg.norm(translation, axis=1), shortest * graph.steps.numpy()))


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

    @classmethod
    def of(
        cls,
        graph: ViewGraph,
        translation: np.ndarray,
        drawn: ClosureGraph,
        steps: np.ndarray,
        body_from_world: np.ndarray,
    ) -> Displacements:
        """At some orientations.

        Args:
            graph: of N nodes and M edges.
            translation: ``(M, 3)`` position of the target in the source's frame, metres.
            drawn: the same graph, drawn together into S segments.
            steps: ``(S,)`` their variance, in that of one step.
            body_from_world: ``(4, N)``.
        """
        forest, num_segments = drawn.paths.forest, drawn.num_segments
        source = graph.source.numpy()
        num_nodes, num_edges = graph.num_nodes, len(drawn.source)
        length = lengths_passed(graph, translation)
        world = rotate_back(body_from_world.take(source, axis=1), translation)

        node = np.flatnonzero(drawn.paths.hangs_on_odometry)
        parent, edge = forest.parent[node], forest.parent_edge[node]
        segment, is_forward = drawn.segment_of_edge[edge], source[edge] == parent
        step = np.where(is_forward[:, None], world[edge], -world[edge])
        end = drawn.nodes[drawn.target[:num_segments]]
        of_parent, of_node = drawn.fraction[parent], np.where(end[segment] == node, 1.0, drawn.fraction[node])
        variance_steps = steps[segment] * (of_node - of_parent)

        def summed(value: np.ndarray) -> np.ndarray:
            return np.stack([np.bincount(segment, column, num_segments) for column in value.T], axis=1)

        def along(value: np.ndarray) -> np.ndarray:
            """From the key node above up to each node."""
            out = np.zeros((num_nodes, value.shape[1]))
            out[node] = value
            total = np.stack([accumulate_to_root(forest, column) for column in out.T], axis=1)
            return np.asarray(total - total[drawn.nodes[drawn.above]])

        whole = summed(step)
        at_target = summed(np.where(is_forward, of_parent, of_node)[:, None] * step)
        way = along(step)
        passed_by = np.where(
            is_forward[:, None], _at_ends(way[node], whole[segment], end[segment] == node), way[parent]
        )
        d = whole[segment] - passed_by - at_target[segment]
        second = summed((variance_steps[:, None, None] * d[:, :, None] * d[:, None, :]).reshape(len(d), 9))
        second = second.reshape(-1, 3, 3)
        trace = np.trace(second, axis1=1, axis2=2)[:, None, None]
        other = drawn.view_graph_edge
        nothing = np.zeros((len(other), 3))
        return cls(
            np.concatenate((whole, world[other])),
            np.concatenate((whole - at_target, world[other])),
            np.concatenate((at_target, nothing)),
            np.concatenate((trace * np.eye(3) - second, np.zeros((num_edges - num_segments, 3, 3)))),
            np.concatenate((np.bincount(segment, length[edge], num_segments), length[other])),
            along(variance_steps[:, None] * d),
            along(length[edge][:, None])[:, 0],
            way,
        )


def _at_ends(way: np.ndarray, whole: np.ndarray, is_end: np.ndarray) -> np.ndarray:
    """A key node is its own key node above, though it is the end of the segment before, too."""
    return np.asarray(np.where(is_end[:, None], whole, way))
