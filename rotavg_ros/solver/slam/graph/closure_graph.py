"""The closure graph: a SLAM pose graph with its odometry chains contracted.

A keyframe between two odometry edges and without a closure carries no information of its own. So a run of k odometry
steps is one *segment* with k times the variance, and only *key nodes* are left: the ends of closures, and the places
where the odometry begins, branches or ends. All orientations are written as a correction of the odometry's,

    R_v = R_v⁰ C_v        (R⁰: composed along the spanning forest; C: a rotation of the world frame),

so a segment says C_b ≈ C_a, and any other edge says C_v ≈ e⁰_uv C_u with e⁰_uv its residual under R⁰. Inside a segment
the least-squares solution turns in proportion to the variance passed, which makes the contraction exact.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import torch
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.solver.algebra import quaternion_rows
from rotavg_ros.solver.algebra.pointer_jumping import follow
from rotavg_ros.solver.slam.graph.odometry_paths import OdometryPaths
from rotavg_ros.view_graph import ViewGraph


@dataclass(frozen=True)
class Restated:
    """n closures that only say what odometry between their ends says; they pull nothing.

    Attributes:
        edge: ``(n,)`` the view-graph's edges.
        ends: ``(2, n)`` nodes, source and target.
        steps: ``(n,)`` odometry steps between them.
    """

    edge: np.ndarray
    ends: np.ndarray
    steps: np.ndarray


@dataclass(frozen=True)
class ClosureGraph:
    """K key nodes and E edges: S segments first, then other edges of the view-graph, sorted by their ends.

    Attributes:
        nodes: ``(K,)`` view-graph nodes, ascending.
        position: ``(K,)`` odometry steps along the node's chain from the chain's lowest end; chains are far apart, in
            the order of these ends.
        roots: ``(components,)`` key nodes whose correction stays the identity.
        source, target: ``(E,)`` key nodes.
        residual: ``(E, 4)`` float64 e⁰; the identity on segments.
        is_odometry: ``(E,)`` bool; all segments, and odometry edges outside the forest.
        own_steps: ``(E,)`` variance of each edge's own noise in units of one edge of its kind: odometry steps passed;
            1 for closures.
        stated_variance: ``(E,)`` rad², as stated by closures; NaN where unknown, and for odometry.
        path_steps: ``(E,)`` odometry steps between the edge's ends along the forest; inf if a closure is passed.
        view_graph_edge: ``(E - S,)`` the view-graph edge of each edge that is no segment.
        restated: closures that are made of odometry and are none of the E edges.
        segment_of_edge: ``(M,)`` the segment that contains each view-graph edge; -1 for edges in none.
        share_of_segment: ``(M,)`` share of its segment's steps that each view-graph edge has; 1 for edges in none.
        paths: paths along the spanning forest, with R⁰.
    """

    nodes: np.ndarray
    position: np.ndarray
    roots: np.ndarray
    source: np.ndarray
    target: np.ndarray
    residual: Tensor
    is_odometry: np.ndarray
    own_steps: np.ndarray
    stated_variance: np.ndarray
    path_steps: np.ndarray
    view_graph_edge: np.ndarray
    restated: Restated
    segment_of_edge: np.ndarray
    share_of_segment: np.ndarray
    paths: OdometryPaths
    # Every view-graph node lies `fraction` of the way (in variance) from key node `above` to key node `below`.
    above: np.ndarray
    below: np.ndarray
    fraction: np.ndarray
    # Odometry steps between the two; 0 at a key node.
    length: np.ndarray

    @property
    def odometry_orientation(self) -> Tensor:
        """R⁰, body_from_world ``(N, 4)``."""
        return self.paths.orientation

    @property
    def num_nodes(self) -> int:
        return len(self.nodes)

    @property
    def num_segments(self) -> int:
        return len(self.source) - len(self.view_graph_edge)

    @property
    def is_restated(self) -> np.ndarray:
        """``(M,)`` bool, the view-graph's closures that are made of odometry."""
        out = np.zeros(len(self.segment_of_edge), dtype=bool)
        out[self.restated.edge] = True
        return out

    @property
    def is_beside(self) -> np.ndarray:
        """``(E,)`` bool, odometry beside the chain."""
        return np.asarray(self.is_odometry & (np.arange(len(self.source)) >= self.num_segments))

    @property
    def is_closure(self) -> np.ndarray:
        return ~self.is_odometry

    @property
    def chain(self) -> np.ndarray:
        """``(K,)`` the chain of odometry that each key node belongs to, by the chain's lowest end."""
        return np.asarray(self.paths.chain[self.nodes])

    @property
    def span(self) -> np.ndarray:
        """``(2, E)`` positions of each edge's older and newer end."""
        return np.sort(self.position[np.stack((self.source, self.target))], axis=0)

    def behind(self, segment: int) -> np.ndarray:
        """``(K,)`` bool, the key nodes that follow a segment along its chain."""
        chain, newer = self.chain, self.span[1, segment]
        return np.asarray((chain == chain[self.source[segment]]) & (self.position >= newer))

    @property
    def is_forward(self) -> np.ndarray:
        """``(E,)`` bool, whether edges are stated from the older to the newer end; if equally old, from low to high."""
        older, newer = self.position[self.source], self.position[self.target]
        return np.where(older == newer, self.source < self.target, older < newer)

    def orientations(self, correction: Tensor) -> Tensor:
        """Corrections of the key nodes ``(K, 4)`` → orientations of all nodes, body_from_world ``(N, 4)``."""
        odometry = self.odometry_orientation.numpy()
        return torch.from_numpy(quaternion_rows.spread(odometry, correction.numpy(), self._between, self.fraction))

    @property
    def first(self) -> np.ndarray:
        """``(N,)`` the view-graph's node that each one is stated relative to: the first of its component."""
        component = self.paths.forest.component
        return np.asarray(np.unique(component, return_index=True)[1][component])

    @property
    def is_held_at_first(self) -> bool:
        """Whether each component's root, an end of odometry, is its first node."""
        return np.array_equal(np.unique(self.first), np.sort(self.nodes[self.roots]))

    @property
    def first_column(self) -> np.ndarray:
        """``(K, 1)`` first nodes by key nodes, all components in one column, since they share no unknowns."""
        first, column = np.unique(self.first), np.zeros((self.num_nodes, 1))
        np.add.at(column[:, 0], self.above[first], 1 - self.fraction[first])
        np.add.at(column[:, 0], self.below[first], self.fraction[first])
        return column

    @property
    def _between(self) -> np.ndarray:
        """``(N, 2)`` key nodes above and below."""
        return np.stack((self.above, self.below), axis=1)

    def variance(
        self, own: np.ndarray, apart: np.ndarray, step_variance: float, with_first: np.ndarray | None = None
    ) -> np.ndarray:
        """Variance of all nodes ``(N,)``, rad².

        Inside a segment the error is interpolated between the ends, plus a Brownian bridge.

        Args:
            own: ``(K,)`` rad², variances of the key nodes.
            apart: ``(S,)`` rad², variance of the difference between both ends of each segment.
            step_variance: rad², variance of one step of odometry.
            with_first: ``(K,)`` rad², H⁻¹ :attr:`first_column`, for variances relative to the first nodes; None:
                relative to the roots.
        """
        across = np.zeros(self.num_nodes)
        across[self.target[: self.num_segments]] = apart
        rest = self.fraction * (1 - self.fraction)
        variance = self.interpolated(own) + rest * (self.length * step_variance - across[self.below])
        if with_first is None:
            return np.asarray(variance)
        first = self.first
        inside = (self.above == self.above[first]) & (self.below == self.below[first])
        bridge = np.minimum(self.fraction, self.fraction[first]) - self.fraction * self.fraction[first]
        common = self.interpolated(with_first) + inside * bridge * self.length * step_variance
        return np.asarray(np.maximum(variance + variance[first] - 2 * common, 0.0))

    def interpolated(self, value: np.ndarray) -> np.ndarray:
        """``(N,)`` of values ``(K,)`` of the key nodes."""
        return np.asarray((1 - self.fraction) * value[self.above] + self.fraction * value[self.below])

    def corrections(self, body_from_world: Tensor) -> Tensor:
        """Orientations of all nodes ``(N, 4)`` → corrections of the key nodes ``(K, 4)``."""
        nodes = torch.from_numpy(self.nodes)
        relative = rotations.multiply(rotations.inverse(self.odometry_orientation[nodes]), body_from_world[nodes])
        return rotations.normalize(relative)

    def from_roots(self, correction: Tensor) -> Tensor:
        """Corrections ``(K, 4)`` in another gauge: each component turned such that its root's is the identity."""
        links = coo_array((np.ones(len(self.source)), (self.source, self.target)), shape=(len(self.nodes),) * 2)
        component = connected_components(links, directed=False)[1]
        root = np.empty(len(self.roots), dtype=np.int64)
        root[component[self.roots]] = self.roots
        back = rotations.inverse(correction[torch.from_numpy(root[component])])
        return rotations.normalize(rotations.multiply(correction, back))

    def from_first(self, correction: np.ndarray) -> np.ndarray:
        """Corrections ``(4, K)`` in the gauge in which those of the first nodes are the identity."""
        if self.is_held_at_first:
            return correction
        first = self.first[self.nodes]
        own = np.tile([0.0, 0.0, 0.0, 1.0], (len(first), 1)), np.ascontiguousarray(correction.T)
        of_first = quaternion_rows.spread(*own, self._between[first], self.fraction[first])
        back = quaternion_rows.inverse(np.ascontiguousarray(of_first.T))
        return np.asarray(quaternion_rows.normalize(quaternion_rows.multiply(correction, back)))

    def edge_values(self, value: np.ndarray, restated: np.ndarray | float) -> np.ndarray:
        """Values of this graph's edges ``(E,)`` → values of the view-graph's edges ``(M,)``.

        Args:
            value: values of this graph's edges.
            restated: values of the closures that are made of odometry, one for all or ``(n,)``.
        """
        out = np.empty(len(self.segment_of_edge))
        out[self.restated.edge] = restated
        on_segment = self.segment_of_edge >= 0
        out[on_segment] = value[: self.num_segments][self.segment_of_edge[on_segment]]
        out[self.view_graph_edge] = value[self.num_segments :]
        return out

    def off_odometry(self, body_from_world: np.ndarray) -> np.ndarray:
        """``(n,)`` rad by which orientations ``(N, 4)`` contradict the closures that are made of odometry."""
        correction = quaternion_rows.multiply(
            quaternion_rows.inverse(self.odometry_orientation.numpy().T), np.ascontiguousarray(body_from_world.T)
        )
        source, target = (correction[:, end] for end in self.restated.ends)
        turned = quaternion_rows.log(quaternion_rows.multiply(quaternion_rows.inverse(source), target))
        return np.asarray(np.sqrt((turned**2).sum(axis=0)))

    def passing(self, passed: np.ndarray) -> ClosureGraph:
        """The graph with nodes placed within their segments by ``passed`` ``(N,)``, counted from the roots."""
        start, end = passed[self.nodes[self.above]], passed[self.nodes[self.below]]
        length = end - start
        fraction = np.divide(passed - start, length, out=self.fraction.copy(), where=length > 0)
        return replace(self, fraction=fraction, length=length)

    def varying(self, relative: np.ndarray) -> ClosureGraph:
        """The graph whose segments have ``relative`` ``(E,)`` times the variance, evenly along each."""
        of_node = np.ones(self.num_nodes)
        of_node[self.target[: self.num_segments]] = relative[: self.num_segments]
        return replace(self, length=self.length * of_node[self.below])


def contract(graph: ViewGraph, paths: OdometryPaths, restated: np.ndarray | None = None) -> ClosureGraph:
    """The closure graph of ``graph`` (on the CPU), its odometry chains contracted along ``paths``.

    Args:
        graph: N nodes, M edges.
        paths: its paths along a spanning forest.
        restated: ``(M,)`` bool, edges that are made of odometry and are left out; default none.
    """
    tells = np.ones(len(paths.outside), dtype=bool) if restated is None else ~restated[paths.outside]
    forest = paths.forest
    num_nodes, num_edges = graph.num_nodes, graph.num_edges
    source, target = graph.source.numpy(), graph.target.numpy()
    is_odometry = graph.is_odometry.numpy()
    steps = graph.steps.numpy()
    parent, parent_edge = forest.parent, forest.parent_edge
    hangs_on_odometry, depth, other = paths.hangs_on_odometry, paths.depth, paths.outside[tells]
    left_out = paths.outside[~tells]

    children = np.bincount(parent[hangs_on_odometry], minlength=num_nodes)
    is_key = ~hangs_on_odometry | (children != 1)
    is_key[source[other]] = True
    is_key[target[other]] = True
    nodes = np.flatnonzero(is_key)
    key_of_node = np.cumsum(is_key) - 1

    above_node = follow(np.where(is_key, np.arange(num_nodes), parent))
    only_child = np.arange(num_nodes)
    only_child[parent[hangs_on_odometry]] = np.flatnonzero(hangs_on_odometry)
    below_node = follow(np.where(is_key, np.arange(num_nodes), only_child))
    length = depth[below_node] - depth[above_node]
    fraction = np.divide(depth - depth[above_node], length, out=np.zeros(num_nodes), where=length > 0)

    # A segment ends at a key node that hangs on odometry; it starts at the next key node above.
    segment_end = nodes[hangs_on_odometry[nodes]]
    segment_start = above_node[parent[segment_end]]
    segment_of_key = np.full(num_nodes, -1, dtype=np.int64)
    segment_of_key[segment_end] = np.arange(len(segment_end))
    segment_of_edge = np.full(num_edges, -1, dtype=np.int64)
    below_edge = np.flatnonzero(hangs_on_odometry)
    segment_of_edge[parent_edge[below_edge]] = segment_of_key[below_node[below_edge]]

    segment_steps = depth[segment_end] - depth[segment_start]
    share_of_segment = np.ones(num_edges)
    on_segment = segment_of_edge >= 0
    share_of_segment[on_segment] = steps[on_segment] / segment_steps[segment_of_edge[on_segment]]
    own_steps = np.concatenate((segment_steps, np.where(is_odometry, steps, 1.0)[other]))
    with np.errstate(over="ignore"):  # of a precision that is next to nothing
        stated_variance = np.where(is_odometry, np.nan, 1 / graph.precision.numpy())[other]
    _, chain_number = np.unique(paths.chain, return_inverse=True)
    return ClosureGraph(
        nodes=nodes,
        position=(paths.position + 4.0 * max(num_nodes, paths.position.max(initial=0.0)) * chain_number)[nodes],
        roots=key_of_node[forest.roots],
        source=key_of_node[np.concatenate((segment_start, source[other]))],
        target=key_of_node[np.concatenate((segment_end, target[other]))],
        residual=torch.cat((rotations.identity(len(segment_end)), paths.residual[torch.from_numpy(tells)])),
        is_odometry=np.concatenate((np.ones(len(segment_end), dtype=bool), is_odometry[other])),
        own_steps=own_steps,
        stated_variance=np.concatenate((np.full(len(segment_end), np.nan), stated_variance)),
        path_steps=np.concatenate((segment_steps, paths.path_steps[tells])),
        view_graph_edge=other,
        restated=Restated(left_out, np.stack((source[left_out], target[left_out])), paths.path_steps[~tells]),
        segment_of_edge=segment_of_edge,
        share_of_segment=share_of_segment,
        paths=paths,
        above=key_of_node[above_node],
        below=key_of_node[below_node],
        fraction=fraction,
        length=length,
    )
