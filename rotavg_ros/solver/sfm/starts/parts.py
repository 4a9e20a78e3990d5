"""Parts that few edges join to the rest of a graph, and turns of them under which more of these edges agree.

Steps that start from a wrong turn of such a part do not leave it: the part's inner edges hold it together, and of the
few edges that join it, false ones may fit. So a spanning tree is built along the edges whose ends have most neighbours
in common. An edge that leaves a part has few, so the tree leaves it only once, and the part is a branch of the tree.
Each edge that joins a branch to the rest states how the branch would have to turn for the edge to fit. The statement
that lowers Σ w ‖r‖^½ most leads to a better solution, the one that raises it least to a rival of the best one.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from rotavg_ros.solver.algebra import quaternion_rows as rows
from rotavg_ros.solver.algebra.canonical_form import evenly_spread
from rotavg_ros.solver.algebra.pointer_jumping import doublings, follow, lowest_common_ancestors, sums_of_branches
from rotavg_ros.solver.algebra.spanning_forest import SpanningForest, accumulate_to_root, minimum_spanning_forest
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.sfm.priors import RefinementPriors
from rotavg_ros.view_graph import EdgeLabel, ViewGraph

# Number of pairs of statements, or of neighbours, that are compared at a time; bounds the memory.
_AT_A_TIME = 1 << 20
# Cost, in rad^½, of an accepted edge that is no good one: more than that of all edges that join a part.
_CONTRADICTED = 100.0
# Where an end of an edge has this many times as many neighbours as the other, looking these up among them is faster
# than going through both lists: 50 ns a neighbour against 6 (one core of 2020). No answer depends on it.
_UNEVEN = 8


@dataclass(frozen=True)
class Turns:
    """The best turn of each of K branches.

    Attributes:
        node: ``(K,)`` the branches' topmost nodes.
        change: ``(K,)`` change of the cost if this branch alone is turned; infinite if no edge states a far turn.
        turn: ``(4, K)`` in the world's frame: orientations become body_from_world · turn.
    """

    node: np.ndarray
    change: np.ndarray
    turn: np.ndarray

    @classmethod
    def least(
        cls, node: np.ndarray, branch: np.ndarray, tries: np.ndarray, cost: np.ndarray, stated: np.ndarray
    ) -> Turns:
        """Of the turns that edges state the one of least cost for each branch; of several, the first.

        Args:
            node: ``(K,)``.
            branch: ``(P,)`` index of the branch that an edge joins.
            tries: ``(T,)`` the edges whose turns are tried.
            cost: ``(T,)`` change of the cost by each.
            stated: ``(4, P)`` the turns.
        """
        order = np.lexsort((tries, cost, branch[tries]))
        at, first = np.unique(branch[tries[order]], return_index=True)
        chosen = order[first]
        change, turn = np.full(len(node), np.inf), rows.identities(len(node))
        change[at] = cost[chosen]
        turn[:, at] = stated[:, tries[chosen]]
        return cls(node, change, turn)


@dataclass(frozen=True)
class Parts:
    """Branches of a graph of N nodes and M edges that few edges join to the rest, P such edges in all.

    Attributes:
        source, target: ``(M,)``.
        measured: ``(4, M)`` target_from_source.
        weight: ``(M,)`` w of the cost.
        is_accepted: ``(M,)`` bool, edges that the user has accepted.
        forest: the tree of each component.
        level: ``(N,)`` int, number of the tree's edges between each node and its root.
        size: ``(N,)`` number of nodes of the branch below each node, itself included.
        node: ``(P,)`` topmost node of the branch; sorted.
        edge, inside: ``(P,)`` an edge that joins the branch, and its end within the branch.
    """

    source: np.ndarray
    target: np.ndarray
    measured: np.ndarray
    weight: np.ndarray
    is_accepted: np.ndarray
    forest: SpanningForest
    level: np.ndarray
    size: np.ndarray
    node: np.ndarray
    edge: np.ndarray
    inside: np.ndarray

    @classmethod
    def of(cls, graph: ViewGraph, angle: Tensor, weight: Tensor, priors: RefinementPriors) -> Parts:
        """The parts, given residuals of orientations in which most edges fit.

        Args:
            angle: ``(M,)`` rad, residuals.
            weight: ``(M,)`` w of the cost; edges of hardly any join nothing.
        """
        graph = graph.to("cpu")
        source, target = graph.source.numpy(), graph.target.numpy()
        measured = np.ascontiguousarray(graph.target_from_source.double().numpy().T)
        weights = weight.double().cpu().numpy()
        is_used = weights > priors.density.least_prior
        forest = _tree(graph, is_used & (angle.cpu().numpy() <= NUMBERS.outlier_angle), priors.starts.tree_degree)
        level = accumulate_to_root(forest, np.ones(graph.num_nodes)).astype(np.int64)
        size = sums_of_branches(forest.parent, level, np.ones(graph.num_nodes))
        used = np.flatnonzero(is_used)
        node, edge, inside = _joining(forest, level, source[used], target[used], priors.starts.part_edges)
        is_accepted = (graph.label == EdgeLabel.ACCEPTED).numpy()
        return cls(source, target, measured, weights, is_accepted, forest, level, size, node, used[edge], inside)

    def turns(self, body_from_world: np.ndarray) -> Turns:
        """The best turn of each branch, given orientations ``(4, N)``."""
        node, branch = np.unique(self.node, return_inverse=True)
        stated = self.stated(body_from_world)
        every, angle = np.arange(len(self.edge)), rows.angle(stated[3])
        tries = np.flatnonzero(angle > NUMBERS.outlier_angle)
        cost = np.empty(len(tries))
        begin = 0
        for one, which, other in self.pairs(tries):
            cosine = np.einsum("ip,ip->p", stated[:, one[which]], stated[:, other])
            cost[begin : begin + len(one)] = np.bincount(which, self._costs(other, rows.angle(cosine)), len(one))
            begin += len(one)
        cost -= np.bincount(branch, self._costs(every, angle), len(node))[branch[tries]]
        return Turns.least(node, branch, tries, cost, stated)

    def _costs(self, chosen: np.ndarray, angle: np.ndarray) -> np.ndarray:
        """Cost w |r|^½ of some of the P edges, with residuals in rad; accepted ones have to be good."""
        edge = self.edge[chosen]
        is_contradicted = self.is_accepted[edge] & (angle > NUMBERS.outlier_angle)
        return np.asarray(self.weight[edge] * (np.sqrt(angle) + _CONTRADICTED * is_contradicted))

    def pairs(self, chosen: np.ndarray) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
        """Some of the P edges, each beside all edges that join the same branch; some millions of pairs at a time.

        Yields:
            ``(k,)`` the next of the chosen ones, and for each pair which of these it is of, and the other edge.
        """
        _, first, branch = np.unique(self.node, return_index=True, return_inverse=True)
        count = np.diff(np.append(first, len(branch)))
        size = count[branch[chosen]]
        for begin, end in pairwise(_bounds(size)):
            one, of = chosen[begin:end], size[begin:end]
            which = np.repeat(np.arange(len(one)), of)
            yield one, which, np.arange(len(which)) - np.repeat(np.cumsum(of) - of, of) + first[branch[one]][which]

    def improved(self, body_from_world: np.ndarray, priors: RefinementPriors) -> np.ndarray | None:
        """The orientations ``(4, N)`` after turns that lower the cost; None if none does."""
        is_turned = False
        for _ in range(priors.starts.turned_rounds):
            turns = self.turns(body_from_world)
            if not bool((turns.change < 0).any()):
                break
            body_from_world, is_turned = self.turned(body_from_world, turns, self.gaining(turns)), True
        return body_from_world if is_turned else None

    def gaining(self, turns: Turns) -> np.ndarray:
        """Branches ``(K,)`` whose turns are a gain; of branches that the same edge joins, the one that gains most."""
        branch = np.searchsorted(turns.node, self.node)
        of_edge, of_branch = np.full(len(self.source), np.inf), np.full(len(turns.node), np.inf)
        np.minimum.at(of_edge, self.edge, turns.change[branch])
        np.minimum.at(of_branch, branch, of_edge[self.edge])
        return np.asarray((turns.change < 0) & (turns.change <= of_branch))

    def rival(self, body_from_world: np.ndarray, priors: RefinementPriors) -> np.ndarray | None:
        """The orientations with a turn, in each component, that raises the cost least; None if all raise it by much.

        Branches are left out that are too small, or too large, to make another solution.
        """
        turns, component = self.turns(body_from_world), self.forest.component
        of_branch = component[turns.node]
        share = self.size[turns.node] / np.bincount(component)[of_branch]
        is_part = np.minimum(share, 1 - share) > priors.rival_share
        change = np.where(is_part & (turns.change >= 0), turns.change, np.inf)
        if not bool(np.isfinite(change).any()):
            return None
        least = np.full(int(component.max()) + 1, np.inf)
        np.minimum.at(least, of_branch, change)
        angle = rows.angle(rows.residual(body_from_world, self.measured, self.source, self.target)[3])
        cost = np.bincount(component[self.source], self.weight * np.sqrt(angle), len(least))
        chosen = (change <= least[of_branch]) & (change < priors.rival_cost * cost[of_branch])
        return self.turned(body_from_world, turns, chosen) if chosen.any() else None

    def stated(self, body_from_world: np.ndarray) -> np.ndarray:
        """``(4, P)`` how each edge's branch would have to turn: W with R_inside W R_outside⁻¹ = measured."""
        outside = self.source[self.edge] + self.target[self.edge] - self.inside
        measured = self.measured[:, self.edge]
        measured = np.where(self.target[self.edge] == self.inside, measured, rows.inverse(measured))
        at_inside, at_outside = body_from_world[:, self.inside], body_from_world[:, outside]
        return np.asarray(rows.multiply(rows.inverse(at_inside), rows.multiply(measured, at_outside)))

    def turned(self, body_from_world: np.ndarray, turns: Turns, chosen: np.ndarray) -> np.ndarray:
        """The orientations ``(4, N)`` after the turns of the chosen branches ``(K,)``."""
        turn = rows.identities(body_from_world.shape[1])
        turn[:, turns.node[chosen]] = turns.turn[:, chosen]
        # Inner branches turn first, within the larger ones that they are in.
        for ancestor, _ in doublings(self.forest.parent):
            turn = rows.multiply(turn, turn[:, ancestor])
        return np.asarray(rows.normalize(rows.multiply(body_from_world, turn)))


def _tree(graph: ViewGraph, fits: np.ndarray, degree: int) -> SpanningForest:
    """The forest along edges that fit ``(M,)`` and whose ends have most neighbours in common; ``degree`` per source."""
    few = evenly_spread(graph.source, graph.num_nodes, degree).numpy()
    few = few[fits[few]]
    source, target = graph.source.numpy()[few], graph.target.numpy()[few]
    cost = np.where(fits, 2.0, 3.0)
    cost[few] = 1 / (1 + _common_neighbours(graph.num_nodes, source, target))
    return minimum_spanning_forest(graph, torch.from_numpy(cost))


def _common_neighbours(num_nodes: int, source: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Number ``(K,)`` of paths of two edges between each edge's ends; time and memory are of the shorter lists."""
    ends = np.concatenate((source, target)), np.concatenate((target, source))
    adjacency = csr_array((np.ones(len(ends[0]), dtype=np.int32), ends), (num_nodes, num_nodes))
    adjacency.sort_indices()
    degree = np.diff(adjacency.indptr)
    is_shorter = degree[source] <= degree[target]
    short, long = np.where(is_shorter, source, target), np.where(is_shorter, target, source)
    # Going through both lists is faster, but each edge of a hub would go through all the others.
    is_uneven = degree[long] > _UNEVEN * degree[short]
    common = np.empty(len(source))
    common[~is_uneven] = adjacency[short[~is_uneven]].multiply(adjacency[long[~is_uneven]]).sum(axis=1)
    common[is_uneven] = _looked_up(adjacency, short[is_uneven], long[is_uneven])
    return common


def _looked_up(adjacency: csr_array, short: np.ndarray, long: np.ndarray) -> np.ndarray:
    """Number ``(K,)`` of paths of two edges, by looking the neighbours of ``short`` up among those of ``long``."""
    size, first = np.diff(adjacency.indptr)[short], adjacency.indptr[short]
    common = np.empty(len(short))
    for begin, end in pairwise(_bounds(size)):
        of = size[begin:end]
        which = np.repeat(np.arange(len(of)), of)
        place = np.arange(len(which)) + np.repeat(first[begin:end] - np.cumsum(of) + of, of)
        found = np.asarray(adjacency[long[begin:end][which], adjacency.indices[place]]).ravel()
        common[begin:end] = np.bincount(which, found * adjacency.data[place], len(of))
    return common


def _joining(
    forest: SpanningForest, level: np.ndarray, source: np.ndarray, target: np.ndarray, most_edges: int
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Edges that join branches with at most ``most_edges`` of them; sorted.

    Returns:
        The branch's topmost node, the edge, and the edge's end inside, ``(P,)`` each.
    """
    parent, is_root, number = forest.parent, forest.parent_edge < 0, np.arange(len(source))
    meeting = lowest_common_ancestors(parent, level, source, target)
    ends = np.bincount(np.concatenate((source, target)), minlength=len(parent))
    count = sums_of_branches(parent, level, ends - 2.0 * np.bincount(meeting, minlength=len(parent)))
    is_few = (count <= most_edges) & ~is_root
    # The nearest node upwards, itself included, whose branch has few; a root if there is none.
    nearest = follow(np.where(is_few | is_root, np.arange(len(parent)), parent))
    found = [(number[:0], number[:0], number[:0])]
    for end in (source, target):
        node, edge = nearest[end], number
        while len(edge):
            is_below = is_few[node] & (level[node] > level[meeting[edge]])
            node, edge = node[is_below], edge[is_below]
            found.append((node, edge, end[edge]))
            node = nearest[parent[node]]
    node, edge, inside = (np.concatenate(column) for column in zip(*found, strict=True))
    order = np.lexsort((edge, node))
    return node[order], edge[order], inside[order]


def _bounds(size: np.ndarray) -> list[int]:
    """Bounds of stretches whose sizes come to about :data:`_AT_A_TIME` each."""
    cut = np.flatnonzero(np.diff(np.cumsum(size) // _AT_A_TIME)) + 1
    return [0, *cut.tolist(), len(size)]
