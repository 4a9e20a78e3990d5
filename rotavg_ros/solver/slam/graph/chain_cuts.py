"""Which closures join chains of odometry otherwise: agreement and minimum cuts, counted in runs of closures.

The closures of a run repeat each other whether they are right or wrong, so a run counts once.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

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
