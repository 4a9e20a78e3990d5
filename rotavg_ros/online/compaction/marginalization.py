"""Taking keyframes out of a pose graph without changing what it says about the others.

A keyframe v between two odometry edges u → v → x and without a loop closure can be integrated out: rotations are
composed, ``R_xu = R_xv R_vu``, variances are added. That is what :mod:`rotavg_ros.solver.slam.graph.closure_graph` does
for every solve anyway, so the solution at all other keyframes stays the same. What else is needed of the steps, how far
each turned and where it led, the edge keeps as sums (:mod:`rotavg_ros.odometry_route`). Long runs of such keyframes are
removed in a few vectorised rounds, each of which takes an independent set out of those left (Luby 1986).

Where several odometries tie v to u and to x, each of them is composed by itself. If their variances have one ratio on
either side, that is exact as well, whatever the ratio is: with the sums w, z of their precisions on either side,
1 / (1/w + 1/z) is the sum of the same of each. The solver estimates the ratio.
"""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
import torch
from numpy.typing import NDArray

from rotavg_ros import rotations
from rotavg_ros.odometry_route import ROUTE_COLUMNS, Routes, joined
from rotavg_ros.online.compaction.chain import Columns, OdometryPairs
from rotavg_ros.online.compaction.marginalized_keyframes import MarginalizedKeyframes
from rotavg_ros.online.measurements import OWN_EDGE_ID


@dataclass(frozen=True)
class Contraction:
    """What became of a graph's N nodes and M edges (N', M' afterwards).

    Attributes:
        kept: ``(N',)`` the nodes that are left, ascending.
        edges: the edges that are left; ends are new nodes.
        routes: ``(R', 38)`` routes of some of them.
        last: ``(M',)`` ascending, the last of the old edges that each consists of.
        edge_of: ``(M,)`` the new edge that each old one has become part of.
        marginalized: the earlier marginalised keyframes, then the new ones.
    """

    kept: NDArray[np.int64]
    edges: Columns
    routes: NDArray[np.float64]
    last: NDArray[np.int64]
    edge_of: NDArray[np.int64]
    marginalized: MarginalizedKeyframes


def marginalize(
    keyframes: Columns,
    edges: Columns,
    routes: NDArray[np.float64],
    remove: NDArray[np.bool_],
    marginalized: MarginalizedKeyframes,
) -> Contraction:
    """Take out the nodes of a mask ``(N,)``.

    Each must have two neighbours, tied to both by equally many edges of plain odometry, and no other edge. Where a
    cycle of odometry would shrink to a pair of nodes, one node in it stays.

    Args:
        keyframes: columns robot, keyframe_id, stamp_ns, time_line.
        edges: see :data:`Columns`.
        routes: ``(R, 38)`` routes of some of the edges.
        remove: ``(N,)`` the mask.
        marginalized: the keyframes marginalised before; their edges are renumbered, their poses kept.
    """
    work = _Work.begin(keyframes, edges, routes, remove, marginalized)
    for layer in _layers(edges, remove, marginalized):
        work.begin_layer(layer)
        while work.round():
            pass
    return work.result()


def _layers(
    edges: Columns, remove: NDArray[np.bool_], marginalized: MarginalizedKeyframes
) -> Iterator[NDArray[np.int64]]:
    """Edges at the nodes to remove, rank by rank: at each node two or none of a rank."""
    carries = np.zeros(len(edges["source"]), dtype=bool)
    carries[marginalized.edge] = True
    touched = np.flatnonzero(remove[edges["source"]] | remove[edges["target"]])
    some = {name: edges[name][touched] for name in ("source", "target", "kind", "label", "steps")}
    rank = OdometryPairs.of(some, carries[touched]).rank
    order = np.argsort(rank, kind="stable")
    bounds = np.searchsorted(rank[order], np.arange(rank.max(initial=-1) + 2))
    for first, last in itertools.pairwise(bounds.tolist()):
        yield touched[order[first:last]]


@dataclass
class _Work:
    """A contraction in progress; edges keep their rows until the end, two merged ones continue in the later row.

    Edges of one rank are merged with each other only. The keyframes are placed on those of the first rank.
    """

    edges: Columns
    routes: NDArray[np.float64]
    riders: Columns
    row_of_node: NDArray[np.int64]
    remove: NDArray[np.bool_]
    incident: NDArray[np.int64]
    merged_into: NDArray[np.int64]
    waiting: NDArray[np.int64]
    num_layers: int = 0  # begun so far
    rank: NDArray[np.int64] = field(init=False)

    def __post_init__(self) -> None:
        self.rank = np.random.default_rng(0).permutation(len(self.remove))

    @classmethod
    def begin(
        cls,
        keyframes: Columns,
        edges: Columns,
        routes: NDArray[np.float64],
        remove: NDArray[np.bool_],
        marginalized: MarginalizedKeyframes,
    ) -> _Work:
        nodes = np.flatnonzero(remove)
        new = MarginalizedKeyframes(
            keyframes["robot"][nodes],
            keyframes["keyframe_id"][nodes],
            keyframes["stamp_ns"][nodes],
            keyframes["time_line"][nodes],
            np.full(len(nodes), -1),
            np.empty((len(nodes), 4)),
            np.empty((len(nodes), 3)),
            np.empty(len(nodes)),
        )
        row_of_node = np.full(len(remove), -1)
        row_of_node[nodes] = len(marginalized) + np.arange(len(nodes))
        return cls(
            {name: values.copy() for name, values in edges.items()},
            routes,
            marginalized.followed_by(new).arrays(),
            row_of_node,
            remove.copy(),
            np.full((len(remove), 2), -1),
            np.arange(len(edges["source"])),
            nodes[:0],
        )

    def begin_layer(self, layer: NDArray[np.int64]) -> None:
        """Go on with the edges of one rank."""
        self.num_layers += 1
        both = np.concatenate((self.edges["source"][layer], self.edges["target"][layer]))
        half_edges = np.flatnonzero(self.remove[both])
        half_edges = half_edges[np.argsort(both[half_edges], kind="stable")]
        self.waiting = both[half_edges[::2]]
        self.incident[self.waiting] = np.tile(layer, 2)[half_edges].reshape(-1, 2)

    def round(self) -> bool:
        """Take out an independent set of the waiting nodes; returns False once none were left."""
        nodes = self.waiting
        if len(nodes) == 0:
            return False
        pair = self.incident[nodes]
        ends = self.edges["source"][pair] + self.edges["target"][pair] - nodes[:, None]
        is_cycle = ends[:, 0] == ends[:, 1]
        self.remove[nodes[is_cycle]] = False
        waits = np.zeros(len(self.remove), dtype=bool)
        waits[nodes[~is_cycle]] = True
        first_comes = waits[ends] & (self.rank[ends] < self.rank[nodes][:, None])
        chosen = ~is_cycle & ~first_comes.any(axis=1)
        backwards = ends[:, 0] > ends[:, 1]
        pair[backwards] = pair[backwards, ::-1]
        ends[backwards] = ends[backwards, ::-1]
        self._merge(nodes[chosen], pair[chosen], ends[chosen])
        self.waiting = nodes[~chosen & ~is_cycle]
        self.incident[self.waiting] = self.merged_into[self.incident[self.waiting]]
        return True

    def _merge(self, nodes: NDArray[np.int64], pair: NDArray[np.int64], ends: NDArray[np.int64]) -> None:
        """Merge the edges u – v – x of each node v, ``pair`` and ``ends`` ``(n, 2)``, into u → x."""
        edges = self.edges
        before, after = pair.T
        before_forwards, after_forwards = edges["target"][before] == nodes, edges["source"][after] == nodes
        v_from_u, v_in_u = _directed(edges, before, before_forwards)
        x_from_v, x_in_v = _directed(edges, after, after_forwards)
        x_from_u, x_in_u = rotations.multiply(x_from_v, v_from_u), _place(v_from_u, v_in_u, x_in_v)
        steps_before, steps = edges["steps"][before], edges["steps"][pair].sum(axis=1)

        # Keyframes that lie on an edge are stored relative to that edge's source: u or v, v or x.
        zero, still = torch.zeros_like(v_in_u), rotations.identity(len(nodes))
        frames = (
            (before, before_forwards, (still, zero, 0 * steps), (v_from_u, v_in_u, steps_before)),
            (after, after_forwards, (v_from_u, v_in_u, steps_before), (x_from_u, x_in_u, steps)),
        )
        survivor = pair.max(axis=1)
        moved = []
        for edge, forwards, source_is_nearer, source_is_farther in frames:
            riders, place = self._riders_on(edge)
            onwards = torch.from_numpy(forwards[place])[:, None]
            turn, origin = (
                torch.where(onwards, near[place], far[place])
                for near, far in zip(source_is_nearer[:2], source_is_farther[:2], strict=True)
            )
            sign = np.where(forwards[place], 1.0, -1.0)
            base = np.where(forwards[place], source_is_nearer[2][place], source_is_farther[2][place])
            moved.append(
                (
                    riders,
                    survivor[place],
                    rotations.multiply(torch.from_numpy(self.riders["keyframe_from_source"][riders]), turn),
                    _place(turn, origin, torch.from_numpy(self.riders["position"][riders])),
                    base + sign * self.riders["steps"][riders],
                )
            )
        for columns in moved:
            self._write_riders(*columns)
        if self.num_layers == 1:
            self._write_riders(self.row_of_node[nodes], survivor, v_from_u, v_in_u, steps_before)

        parts = (before, v_from_u, v_in_u), (after, x_from_v, x_in_v)
        in_order = (ends[:, 0] < nodes) & (nodes < ends[:, 1])
        with np.errstate(divide="ignore"):
            precision = 1 / (1 / edges["precision"][pair]).sum(axis=1)
        self.merged_into[pair.min(axis=1)] = survivor
        values = {
            "source": ends[:, 0],
            "target": ends[:, 1],
            "target_from_source": rotations.normalize(x_from_u).numpy(),
            "translation": x_in_u.numpy(),
            "precision": precision,
            "steps": steps,
            "route": np.where(in_order, len(self.routes) + np.arange(len(nodes)), -1),
            "edge_id": np.uint64(OWN_EDGE_ID),
        }
        with np.errstate(over="ignore", invalid="ignore"):  # a step may have any values
            self.routes = np.concatenate((self.routes, _joined(edges, self.routes, parts)))
        for name, value in values.items():
            edges[name][survivor] = value

    def _riders_on(self, edges: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        """Rows of the marginalised keyframes on the given edges, and the positions of their edges among these."""
        place_of_edge = np.full(len(self.merged_into), -1)
        place_of_edge[edges] = np.arange(len(edges))
        on_edge = self.riders["edge"]
        riders = np.flatnonzero((on_edge >= 0) & (place_of_edge[on_edge] >= 0))
        return riders, place_of_edge[on_edge[riders]]

    def _write_riders(
        self,
        rows: NDArray[np.int64],
        edge: NDArray[np.int64],
        keyframe_from_source: torch.Tensor,
        position: torch.Tensor,
        steps: NDArray[np.float64],
    ) -> None:
        riders = self.riders
        riders["edge"][rows], riders["steps"][rows] = edge, steps
        riders["keyframe_from_source"][rows] = rotations.normalize(keyframe_from_source).numpy()
        riders["position"][rows] = position.numpy()

    def result(self) -> Contraction:
        kept, last = np.flatnonzero(~self.remove), np.flatnonzero(self.merged_into == np.arange(len(self.merged_into)))
        edge_of = self.merged_into
        while not np.array_equal(farther := edge_of[edge_of], edge_of):
            edge_of = farther
        new_edge = np.cumsum(self.merged_into == np.arange(len(edge_of))) - 1
        new_node = np.cumsum(~self.remove) - 1
        edges = {name: values[last] for name, values in self.edges.items()}
        edges["source"], edges["target"] = new_node[edges["source"]], new_node[edges["target"]]
        used, row = np.unique(edges["route"], return_inverse=True)
        edges["route"] = row - int(len(used) and used[0] < 0)
        riders = MarginalizedKeyframes(**self.riders)
        riders = riders.select(riders.edge >= 0)
        riders.edge[:] = new_edge[edge_of[riders.edge]]
        return Contraction(kept, edges, self.routes[used[used >= 0]], last, new_edge[edge_of], riders)


def _directed(
    edges: Columns, chosen: NDArray[np.int64], forwards: NDArray[np.bool_]
) -> tuple[torch.Tensor, torch.Tensor]:
    """Rotation and translation of edges, inverted where they do not run forwards."""
    rotation = torch.from_numpy(edges["target_from_source"][chosen])
    translation = torch.from_numpy(edges["translation"][chosen])
    onwards = torch.from_numpy(forwards)[:, None]
    return (
        torch.where(onwards, rotation, rotations.inverse(rotation)),
        torch.where(onwards, translation, -rotations.rotate(rotation, translation)),
    )


def _joined(
    edges: Columns, known: NDArray[np.float64], parts: Sequence[tuple[NDArray[np.int64], torch.Tensor, torch.Tensor]]
) -> NDArray[np.float64]:
    """``(n, 38)`` the routes of odometry along pairs of edges, in order of time; NaN where not finite.

    Args:
        edges: all edges.
        known: ``(R, 38)`` routes.
        parts: for the first and the second of each pair: the edges, farther_from_nearer rotations of their ends, and
            positions of the farther ends in the frames of the nearer ones.
    """
    routes, turns = [], []
    for edge, farther_from_nearer, place in parts:
        angle = torch.linalg.vector_norm(rotations.log(farther_from_nearer), dim=1).numpy()
        even = Routes.even(angle, place.numpy(), edges["steps"][edge])
        row = edges["route"][edge]
        columns = np.full((len(edge), ROUTE_COLUMNS), np.nan)
        columns[row >= 0] = known[row[row >= 0]]
        routes.append(Routes.known(columns, even))
        turns.append(rotations.to_matrix(rotations.inverse(farther_from_nearer)).numpy())
    steps = [edges["steps"][edge] for edge, _, _ in parts]
    columns = joined(routes, steps, parts[1][2].numpy(), turns[0]).columns
    return np.where(np.isfinite(columns), columns, np.nan)


def _place(frame_from_world: torch.Tensor, origin: torch.Tensor, position: torch.Tensor) -> torch.Tensor:
    """World coordinates of positions in frames at ``origin``."""
    return origin + rotations.rotate(rotations.inverse(frame_from_world), position)
