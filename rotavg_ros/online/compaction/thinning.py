"""Which keyframes and loop closures a full graph can best do without.

Everything is thinned evenly along the robot's path, in dyadic stretches: of the keyframes (and then of the closures)
within a stretch of 2, 4, 8 … odometry steps one stays; older stretches are thinned first. So however long the robot
drives, the rest covers the whole path, and a closure to any place finds a keyframe near by.

1. Keyframes that no closure touches: taking them out changes nothing
   (:mod:`~rotavg_ros.online.compaction.marginalization`).
2. Only if these do not suffice, keyframes that odometry links to more than those next to them
   (:mod:`~rotavg_ros.online.compaction.chain`). Their links go with them, and the chain stays.
3. Only if these do not suffice, closures, and none but those of a keyframe that this frees: first those judged false,
   then those that are the best (the newest that is not flagged) on neither of the two stretches of the path that they
   join, and those that span no more than a stretch. Stretches double until enough is free. So every stretch that has
   closures keeps one. A closure that still waits to be solved is not judged false, whatever its residual; it is better
   than one that is.

Where there are too many edges for the keyframes, odometry beside the chain goes while it outnumbers the closures, the
longest links first; then closures in the order above; then what is left beside the chain.

Closures without which the graph would fall apart stay, and so do those a user has accepted.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from rotavg_ros.online.compaction.chain import Chain, Columns, are_between, is_plain_odometry
from rotavg_ros.view_graph import EdgeKind, EdgeLabel


class Verdict(IntEnum):
    """What the last answer says of an edge; the lower, the sooner it stays."""

    BELIEVED = 0  # or too new to be judged
    UNSOLVED = 1  # flagged for its residual alone, and waiting to be solved
    FALSE = 2


def load() -> None:
    """Load the parts of SciPy that a full graph needs ahead of time, since it takes some tenths of a second."""
    import scipy.sparse.csgraph  # noqa: F401


@dataclass(frozen=True)
class Way:
    """Where the N nodes lie along the odometry.

    Attributes:
        chain: ``(N,)`` number of the odometry chain.
        position: ``(N,)`` odometry steps from the chain's first node; taking nodes out does not change it.
        first: ``(C,)`` first node of each chain.
    """

    chain: NDArray[np.int64]
    position: NDArray[np.float64]
    first: NDArray[np.int64]

    @classmethod
    def along(cls, num_nodes: int, edges: Columns) -> Way:
        from scipy.sparse import coo_array, csr_array  # loaded once a graph is full
        from scipy.sparse.csgraph import connected_components, dijkstra

        odometry = edges["kind"] == EdgeKind.ODOMETRY
        ends = edges["source"][odometry], edges["target"][odometry]
        # The shortest of parallel edges counts; a sparse matrix would add them up.
        low, high, steps = np.minimum(*ends), np.maximum(*ends), edges["steps"][odometry]
        order = np.lexsort((steps, high, low))
        low, high, steps = low[order], high[order], steps[order]
        new = np.ones(len(low), dtype=bool)
        new[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
        adjacency = csr_array(coo_array((steps[new], (low[new], high[new])), shape=(num_nodes, num_nodes)))
        _, label = connected_components(adjacency, directed=False)
        _, first, chain = np.unique(label, return_index=True, return_inverse=True)
        distance = dijkstra(adjacency, directed=False, indices=first, min_only=True)
        return cls(chain, np.asarray(distance), first)

    @property
    def length(self) -> float:
        """Length of the longest chain, steps."""
        return float(self.position.max(initial=0.0))


@dataclass(frozen=True)
class Thinning:
    """What to remove.

    Attributes:
        nodes: ``(N,)`` bool; they can be marginalised once the edges are gone.
        edges: ``(M,)`` bool, those to drop.
    """

    nodes: NDArray[np.bool_]
    edges: NDArray[np.bool_]


def thin(
    edges: Columns,
    verdict: NDArray[np.int8],
    protected: NDArray[np.bool_],
    carries: NDArray[np.bool_],
    surplus_nodes: int,
    surplus_edges: int,
) -> Thinning:
    """Choose what to remove; less than asked for where nothing else can be spared.

    Args:
        edges: of the graph, see :data:`~rotavg_ros.online.compaction.chain.Columns`.
        verdict: ``(M,)`` :class:`Verdict` on each edge.
        protected: ``(N,)`` nodes that must stay; the first of every chain does in any case.
        carries: ``(M,)`` edges that marginalised keyframes lie on; these stay.
        surplus_nodes, surplus_edges: how many to remove.
    """
    way = Way.along(len(protected), edges)
    stays = protected.copy()
    stays[way.first] = True
    source, target = edges["source"], edges["target"]
    dropped, others = np.zeros(len(source), dtype=bool), np.flatnonzero(~is_plain_odometry(edges))

    def untouched(between: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Which of the nodes have no edges left but of plain odometry."""
        free, left = between & ~stays, others[~dropped[others]]
        free[source[left]] = free[target[left]] = False
        return np.asarray(free)

    free = untouched(are_between(len(protected), edges, carries))
    if free.sum() >= surplus_nodes:
        nodes = _evenly(way, free, surplus_nodes)
    else:
        chain = Chain.of(len(protected), edges, carries)
        wanted = min(surplus_nodes, int((chain.between & ~stays).sum()))
        closures = _sparable_closures(way, edges, verdict, stays)
        _drop(dropped, closures, lambda: int(untouched(chain.between).sum()) < wanted)
        nodes = _evenly(way, untouched(chain.between), surplus_nodes)
        # A closure goes for a keyframe that goes, and for no other.
        dropped &= nodes[source] | nodes[target]
        dropped |= chain.gone_with(nodes)
    if nodes.sum() + dropped.sum() < surplus_edges:
        beside = Chain.of(len(protected), edges, carries).beside()
        beside = beside[~(dropped | nodes[source] | nodes[target])[beside]]
        num_closures = int((~dropped & (edges["kind"] == EdgeKind.LOOP_CLOSURE)).sum())
        more = beside[: max(0, len(beside) - num_closures)]
        sparable = itertools.chain([more], _sparable_closures(way, edges, verdict, stays), [beside])
        _drop(dropped, sparable, lambda: int(nodes.sum() + dropped.sum()) < surplus_edges)
    return Thinning(nodes, dropped)


def _drop(dropped: NDArray[np.bool_], sparable: Iterable[NDArray[np.int64]], lacking: Callable[[], bool]) -> None:
    """Drop edges in their order, no more than needed; of those that are equally good the first.

    Args:
        dropped: ``(M,)``; changed in place.
        sparable: arrays of edges, which may repeat earlier ones.
        lacking: whether more have to be dropped.
    """
    if not lacking():
        return
    for some in sparable:
        spared = some[~dropped[some]]
        dropped[spared] = True
        if not lacking():
            enough, count = len(spared), 0
            while enough - count > 1:
                middle = (enough + count) // 2
                dropped[spared] = np.arange(len(spared)) < middle
                enough, count = (enough, middle) if lacking() else (middle, count)
            dropped[spared] = np.arange(len(spared)) < enough
            return


def _evenly(way: Way, free: NDArray[np.bool_], count: int) -> NDArray[np.bool_]:
    """``count`` of the free nodes ``(N,)``, so that the rest is spread evenly; all of them if there are fewer."""
    if free.sum() <= count:
        return free
    less, width = np.zeros_like(free), 2.0
    while True:
        stretch = np.floor_divide(way.position, width)
        # Nodes that stay anyway are sorted first in their stretch and represent it.
        order = np.lexsort((free, stretch, way.chain))
        first = np.ones(len(order), dtype=bool)
        first[1:] = (np.diff(way.chain[order]) != 0) | (np.diff(stretch[order]) != 0)
        more = free.copy()
        more[order[first]] = False
        if width > way.length:
            more = free
        if more.sum() >= count:
            added = np.flatnonzero(more & ~less)[: count - int(less.sum())]
            less[added] = True
            return less
        less, width = more, 2 * width


def _sparable_closures(
    way: Way, edges: Columns, verdict: NDArray[np.int8], stays: NDArray[np.bool_]
) -> Iterator[NDArray[np.int64]]:
    """Closures in the order of removal: ascending arrays of edge indices, which may repeat earlier ones."""
    source, target = edges["source"], edges["target"]
    verdict = np.where(edges["label"] == EdgeLabel.REJECTED, Verdict.FALSE, verdict).astype(np.int8)
    may_go = (edges["kind"] == EdgeKind.LOOP_CLOSURE) & (edges["label"] != EdgeLabel.ACCEPTED)
    may_go &= ~(stays[source] & stays[target])
    may_go[_bridges(way, edges, verdict)] = False
    yield np.flatnonzero(may_go & (verdict == Verdict.FALSE))

    closure = np.flatnonzero(edges["kind"] == EdgeKind.LOOP_CLOSURE)
    ends = np.stack((source[closure], target[closure]), axis=1)
    ends.sort(axis=1)
    chain, position = way.chain[ends], way.position[ends]
    span = np.where(chain[:, 0] == chain[:, 1], np.abs(position[:, 0] - position[:, 1]), np.inf)
    # The best first: those that have to stay, then by their verdict, then the newest.
    rank = np.empty(len(closure), dtype=np.int64)
    rank[np.lexsort((-closure, verdict[closure], may_go[closure]))] = np.arange(len(closure))
    width = 1.0
    while width < 4 * way.length + 4:
        along = np.floor_divide(position, width).astype(np.int64)
        stretch = np.unique(chain * (along.max(initial=0) + 1) + along, return_inverse=True)[1].reshape(-1, 2)
        best = np.full(stretch.max(initial=-1) + 1, len(closure))
        np.minimum.at(best, stretch, rank[:, None])
        redundant = (best[stretch] != rank[:, None]).all(axis=1) | (span <= width)
        yield closure[redundant & may_go[closure]]
        width *= 2


def _bridges(way: Way, edges: Columns, verdict: NDArray[np.int8]) -> NDArray[np.int64]:
    """Edges of a spanning forest over the odometry chains; those of the better verdict are preferred."""
    from scipy.sparse import coo_array, csr_array
    from scipy.sparse.csgraph import minimum_spanning_tree

    ends = np.stack((way.chain[edges["source"]], way.chain[edges["target"]]), axis=1)
    ends.sort(axis=1)
    between = np.flatnonzero(ends[:, 0] != ends[:, 1])
    low, high = ends[between].T
    order = np.lexsort((verdict[between], high, low))
    low, high, between = low[order], high[order], between[order]
    new = np.ones(len(low), dtype=bool)
    new[1:] = (np.diff(low) != 0) | (np.diff(high) != 0)
    low, high, between = low[new], high[new], between[new]
    shape = (len(way.first), len(way.first))
    tree = minimum_spanning_tree(csr_array(coo_array((1.0 + verdict[between], (low, high)), shape=shape))).tocoo()
    # The keys ascend row by row, as `low` and `high` do.
    place = np.searchsorted(low * len(way.first) + high, tree.row.astype(np.int64) * len(way.first) + tree.col)
    return np.asarray(between[place])
