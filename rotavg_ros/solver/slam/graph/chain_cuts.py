"""Which closures join chains of odometry otherwise: agreement and minimum cuts, counted in runs of closures.

The closures of a run repeat each other whether they are right or wrong, so a run counts once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import breadth_first_order, connected_components

from rotavg_ros.solver.algebra.compiled import compiled
from rotavg_ros.solver.algebra.minimum_cut import FlowNetwork


def with_most_runs(agree: np.ndarray, run: np.ndarray) -> int:
    """The row of ``agree (T, C)`` whose closures, in runs ``(C,)``, are of most runs; of several, of most closures."""
    # A table of closures by runs would take gigabytes where there are many of both.
    order = np.argsort(run, kind="stable")
    first = np.unique(run[order], return_index=True)[1]
    runs = np.logical_or.reduceat(agree[:, order], first, axis=1).sum(axis=1)
    return int(np.lexsort((-agree.sum(axis=1), -runs))[0])


def connected(count: int, ends: np.ndarray) -> np.ndarray:
    """``(n,)`` number of the connected component of each of n = ``count`` chains; closures join ``(B, 2)``."""
    links = coo_array((np.ones(len(ends)), ends.T), shape=(count, count))
    return np.asarray(connected_components(links, directed=False)[1])


def joined_by_others(count: int, ends: np.ndarray) -> np.ndarray:
    """``(B,)`` bool, for each of B closures whether others of them join the chains ``(B, 2)`` that it joins, too."""
    pairs, which, number = np.unique(np.sort(ends, axis=1), axis=0, return_inverse=True, return_counts=True)
    # One tree of all: a root besides the chains leads to one chain of each component.
    first = np.unique(connected(count, pairs), return_index=True)[1]
    linked = np.concatenate((pairs, np.column_stack((first, np.full_like(first, count)))))
    links = coo_array((np.ones(len(linked)), linked.T), shape=(count + 1, count + 1)).tocsr()
    order, above = breadth_first_order(links, count, directed=False)
    is_on_cycle = np.ones(len(pairs), dtype=bool)
    lower = np.where(above[pairs[:, 0]] == pairs[:, 1], pairs[:, 0], pairs[:, 1])
    in_tree = above[lower] == pairs.sum(axis=1) - lower
    is_on_cycle[in_tree] = _on_cycles(order, above, pairs[~in_tree])[lower[in_tree]]
    return np.asarray(((number > 1) | is_on_cycle)[which])


@compiled
def _on_cycles(order: np.ndarray, above: np.ndarray, pairs: np.ndarray) -> np.ndarray:
    """``(n,)`` bool, whether pairs ``(P, 2)`` besides a tree close cycles through each node and the one above it.

    The ways up from both ends of each pair meet; what has been on a cycle once is passed over.
    """
    count = len(above)
    found, leads, depth = np.zeros(count, np.bool_), np.arange(count), np.zeros(count, np.int64)
    for node in order[1:]:
        depth[node] = depth[above[node]] + 1
    for pair in range(len(pairs)):
        one, other = _root(leads, pairs[pair, 0]), _root(leads, pairs[pair, 1])
        while one != other:
            if depth[one] < depth[other]:
                one, other = other, one
            found[one], leads[one] = True, above[one]
            one = _root(leads, one)
    return found


@compiled
def _root(leads: np.ndarray, node: int) -> int:
    """The first node above that is not passed over; ways to it are halved."""
    while leads[node] != node:
        leads[node] = leads[leads[node]]
        node = leads[node]
    return node


@dataclass(frozen=True)
class ChainCuts:
    """What has to be wrong for two of n chains not to be joined.

    Attributes:
        count: n.
        network: of the chains, with an edge for each run of believed closures that joins two of them.
        num_edges: number of these.
    """

    count: int
    network: FlowNetwork
    num_edges: int

    @classmethod
    def of(cls, count: int, ends: np.ndarray, run: np.ndarray) -> ChainCuts:
        """Of believed closures between chains ``(B, 2)``, numbered from 0, in runs ``(B,)``."""
        edges = np.unique(np.column_stack((np.sort(ends, axis=1), run)), axis=0)
        return cls(count, FlowNetwork(count, edges[:, 0], edges[:, 1]), len(edges))

    def beyond(self, first: int, second: int) -> Iterator[np.ndarray]:
        """``(n,)`` bool, chains on the second one's side of a cut of fewest runs, as near to either as there is one."""
        stays, turns = np.eye(self.count)[[first, second]]
        capacity, supply = np.ones(self.num_edges), (self.num_edges + 1) * (stays - turns)
        yield self.network.minimum_cut(capacity, capacity, supply)
        yield ~self.network.minimum_cut(capacity, capacity, -supply)
