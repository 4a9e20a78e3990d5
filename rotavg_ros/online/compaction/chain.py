"""The chain of odometry, and what a front end states beside it.

A second odometry measures between the same keyframes again; many front ends link a keyframe to several before it (VINS,
the covisibility edges of ORB-SLAM, scan matchers). The chain is a spanning forest of odometry over the keyframes that
are nearest to each other, so that it leads from each to the next wherever odometry does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.view_graph import EdgeKind, EdgeLabel

Columns = dict[str, NDArray[Any]]
"""Of the graph's edges, by name: those of :class:`~rotavg_ros.view_graph.ViewGraph`, edge_id and translation."""


def is_plain_odometry(edges: Columns) -> NDArray[np.bool_]:
    """Odometry edges that nobody has labelled, ``(M,)``; these can be merged."""
    return np.asarray((edges["kind"] == EdgeKind.ODOMETRY) & (edges["label"] == EdgeLabel.AUTOMATIC))


@dataclass(frozen=True)
class OdometryPairs:
    """P pairs of nodes that plain odometry connects.

    Attributes:
        ends: ``(P, 2)`` nodes, the lower one first.
        count: ``(P,)`` number of edges.
        is_even: ``(P,)`` bool, whether all of a pair's edges stand for as many steps.
        of_edge: ``(M,)`` pair of each edge, -1 for all that are no plain odometry.
        rank: ``(M,)`` an edge's place among those of its pair, from 0; -1 likewise. Those that marginalised keyframes
            lie on come first, then those of most steps, then the oldest. Where keyframes are taken out, edges of one
            rank are merged, and have that rank again. So each of several odometries stays one by itself.
    """

    ends: NDArray[np.int64]
    count: NDArray[np.int64]
    is_even: NDArray[np.bool_]
    of_edge: NDArray[np.int64]
    rank: NDArray[np.int64]

    @classmethod
    def of(cls, edges: Columns, carries: NDArray[np.bool_]) -> OdometryPairs:
        """The pairs.

        Args:
            edges: M edges.
            carries: ``(M,)`` edges that marginalised keyframes lie on.
        """
        chosen = np.flatnonzero(is_plain_odometry(edges))
        low, high = np.minimum(*(ends := _ends(edges, chosen))), np.maximum(*ends)
        order = np.lexsort((chosen, -edges["steps"][chosen], ~carries[chosen], high, low))
        chosen, low, high = chosen[order], low[order], high[order]
        begins = np.ones(len(chosen), dtype=bool)
        begins[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
        first = np.flatnonzero(begins)
        pair, of_edge, rank = np.cumsum(begins) - 1, *np.full((2, len(carries)), -1)
        of_edge[chosen], rank[chosen] = pair, np.arange(len(chosen)) - first[pair]
        steps = edges["steps"][chosen]
        uneven = np.bincount(pair, steps != steps[first[pair]], len(first)) > 0
        return cls(np.stack((low, high), axis=1)[first], np.bincount(pair), ~uneven, of_edge, rank)

    def are_between(self, num_nodes: int, chosen: NDArray[np.bool_], *, evenly: bool) -> NDArray[np.bool_]:
        """Nodes with exactly two neighbours by the chosen pairs ``(P,)``; as a mask ``(N,)``.

        ``evenly``: only those tied to both by equally many edges, of equal steps on either side. Taking these out is
        exact, since the variances of the odometries have one ratio on either side.
        """
        ends, count = self.ends[chosen], self.count[chosen].astype(np.float64)
        degree = np.bincount(ends.ravel(), minlength=num_nodes)
        if not evenly:
            return np.asarray(degree == 2)
        total, squares, uneven = (
            np.bincount(ends.ravel(), values.repeat(2), num_nodes)
            for values in (count, count**2, ~self.is_even[chosen])
        )
        # Two equal counts n have 2 n² for the sum of squares of n + n; exact in float64.
        return np.asarray((degree == 2) & (2 * squares == total**2) & (uneven == 0))


def are_between(num_nodes: int, edges: Columns, carries: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
    """Nodes that can be taken out without loss unless edges other than plain odometry touch them, ``(N,)``.

    They have exactly two neighbours by plain odometry, to which equally many edges of equal steps tie them.
    """
    nothing = np.zeros(len(edges["source"]), dtype=bool)
    pairs = OdometryPairs.of(edges, nothing if carries is None else carries)
    return pairs.are_between(num_nodes, np.ones(len(pairs.count), dtype=bool), evenly=True)


@dataclass(frozen=True)
class Chain:
    """The chain of N nodes and M edges.

    Attributes:
        pairs: all pairs of plain odometry.
        on_chain: ``(P,)`` which of them are the chain's.
        between: ``(N,)`` bool, nodes with two neighbours along the chain. They can be taken out once what
            :meth:`gone_with` says is dropped, unless edges other than plain odometry touch them.
        carries: ``(M,)`` edges that marginalised keyframes lie on; these are never dropped.
    """

    pairs: OdometryPairs
    on_chain: NDArray[np.bool_]
    between: NDArray[np.bool_]
    carries: NDArray[np.bool_]

    @classmethod
    def of(cls, num_nodes: int, edges: Columns, carries: NDArray[np.bool_]) -> Chain:
        from scipy.sparse import coo_array, csr_array  # loaded once a graph is full
        from scipy.sparse.csgraph import minimum_spanning_tree

        pairs = OdometryPairs.of(edges, carries)
        carrying = np.bincount(pairs.of_edge[carries & (pairs.rank >= 0)], minlength=len(pairs.count))
        low, high = pairs.ends.T
        cost = np.where(carrying > 0, 0.5, high - low)
        tree = minimum_spanning_tree(csr_array(coo_array((cost, (low, high)), shape=(num_nodes, num_nodes)))).tocoo()
        on_chain = np.isin(low * num_nodes + high, tree.row.astype(np.int64) * num_nodes + tree.col)
        between = pairs.are_between(num_nodes, on_chain, evenly=False)
        # Where it would have to drop an edge that marginalised keyframes lie on, a node stays.
        between[pairs.ends[np.where(on_chain, carrying > 1, carrying > 0)]] = False
        return cls(pairs, on_chain, between, carries)

    def beside(self) -> NDArray[np.int64]:
        """Edges beside the chain that can be dropped: those between the farthest keyframes first, then the oldest."""
        pairs = self.pairs
        edge = np.flatnonzero((pairs.rank >= 0) & ~self.carries)
        edge = edge[(pairs.rank[edge] > 0) | ~self.on_chain[pairs.of_edge[edge]]]
        low, high = pairs.ends[pairs.of_edge[edge]].T
        return np.asarray(edge[np.argsort(low - high, kind="stable")])

    def gone_with(self, nodes: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """What of plain odometry is to be dropped so that nodes between ``(N,)`` can be taken out; ``(M,)``.

        That is all beside the chain at these nodes; and, where an odometry is missing at a part of a run of them, that
        odometry in all of the run.
        """
        from scipy.sparse import coo_array
        from scipy.sparse.csgraph import connected_components

        pairs = self.pairs
        touched = nodes[pairs.ends].any(axis=1)
        along = self.on_chain & touched
        inside = pairs.ends[self.on_chain & nodes[pairs.ends].all(axis=1)]
        joined = coo_array((np.ones(len(inside)), inside.T), shape=(len(nodes), len(nodes)))
        _, run = connected_components(joined, directed=False)
        run_of_pair = run[np.where(nodes[pairs.ends[:, 0]], *pairs.ends.T)]
        least = np.full(len(nodes), np.iinfo(np.int64).max)
        np.minimum.at(least, run_of_pair[along], pairs.count[along])
        # How many ranks stay of each pair.
        left = np.where(along, least[run_of_pair], np.where(touched, 0, pairs.count))
        return np.asarray((pairs.rank >= 0) & (pairs.rank >= np.append(left, 0)[pairs.of_edge]))


def _ends(edges: Columns, chosen: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    return edges["source"][chosen], edges["target"][chosen]
