"""Edges in series: those that only check each other.

If removing two edges disconnects a graph, every cycle through one of them passes the other. Then only their total error
is known, not which of them errs. Being such a pair is an equivalence relation, so the edges fall into classes. A lone
cycle is one class. In a well-knit graph every edge is a class of its own.

The classes come from one random flow around the cycles, an integer for each edge whose sums vanish at all nodes: two
edges are in series if their flows are equal or opposite, and so are those of other edges with a probability of 2⁻⁶³
(cycle space sampling, Pritchard & Thurimella 2011).
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.residuals import SLICE_EDGES
from rotavg_ros.solver.neurora.scores import residual_probability
from rotavg_ros.solver.running.threads import for_each, slices, stretches
from rotavg_ros.view_graph import ViewGraph

# SplitMix64's constants, as signed numbers.
_GOLDEN = 0x9E3779B97F4A7C15 - (1 << 64)
_MIXERS = ((30, 0xBF58476D1CE4E5B9 - (1 << 64)), (27, 0x94D049BB133111EB - (1 << 64)))
# The flow's last bits are enough to rule out most edges that are in series with none.
_TABLE = 1 << 16


class EdgesInSeries(NamedTuple):
    """The K edges that are in series with others, in G classes.

    Attributes:
        edge: ``(K,)`` the graph's edges.
        group: ``(K,)`` the class of each.
        num_groups: G.
        blame: ``(K,)`` float64, probability that this edge is the wrong one if one of its class is; initially equal.
        bridge: ``(B,)`` edges on no cycle, which nothing checks.
    """

    edge: Tensor
    group: Tensor
    num_groups: int
    blame: Tensor
    bridge: Tensor

    @classmethod
    def of(cls, graph: ViewGraph, parent: Tensor, parent_edge: Tensor) -> EdgesInSeries:
        """The edges in series of a graph with a spanning forest.

        Args:
            parent, parent_edge: ``(N,)`` each node's parent and the edge to it; of a root itself, and -1.
        """
        is_child = parent_edge >= 0
        in_forest = torch.zeros(graph.num_edges, dtype=torch.bool, device=graph.device)
        in_forest[parent_edge[is_child]] = True
        others = (~in_forest).nonzero().squeeze(1)
        flow = torch.empty_like(others)
        parts = stretches(slices(len(others), SLICE_EDGES, graph.device))
        excesses = [others.new_zeros(graph.num_nodes) for _ in (*parts, None)]

        def flow_along(number: int) -> None:
            for part in parts[number]:
                edge, hashed = others[part], _hashed(others[part])
                flow[part] = hashed
                excesses[number].index_add_(0, graph.source.index_select(0, edge), hashed)
                excesses[number].index_add_(0, graph.target.index_select(0, edge), -hashed)

        for_each(flow_along, range(len(parts)))
        excess = torch.stack(excesses).sum(dim=0)
        forest_flow = _subtree_sums(excess, parent)[is_child].abs()

        seen = torch.zeros(_TABLE, dtype=torch.bool, device=graph.device)
        seen[forest_flow & (_TABLE - 1)] = True
        likely = seen.index_select(0, flow & (_TABLE - 1))
        edge = torch.cat((parent_edge[is_child], others[likely]))
        flows = torch.cat((forest_flow, flow[likely]))
        _, group, size = torch.unique(flows, return_inverse=True, return_counts=True)
        checked = torch.cat((forest_flow != 0, likely.new_ones(int(likely.sum()))))
        chosen = (checked & (size[group] > 1)).nonzero().squeeze(1)
        _, group, size = torch.unique(group[chosen], return_inverse=True, return_counts=True)
        bridge = parent_edge[is_child][forest_flow == 0]
        return cls(edge[chosen], group, len(size), 1 / size.double()[group], bridge)

    def blamed(self, log_odds: Tensor) -> EdgesInSeries:
        """The same edges with blame from their log-odds ``(K,)`` of being wrong."""
        odds = torch.exp(log_odds - log_odds.amax()) if len(log_odds) else log_odds
        return self._replace(blame=odds / self.sums(odds)[self.group])

    def score(self, angle: Tensor, uncertainty: Tensor, outlier_angle: float) -> Tensor:
        """Probability ``(K,)`` that noise exceeds ``outlier_angle``, rad: that of the whole class, times the blame.

        Args:
            angle, uncertainty: ``(K,)`` rad, of the residuals.
        """
        together, spread = self.sums(angle.double()), self.sums(uncertainty.double().square()).sqrt()
        return self.blame * residual_probability(together, spread, outlier_angle)[self.group]

    def sums(self, value: Tensor) -> Tensor:
        """Sums ``(G,)`` of values ``(K,)`` by class."""
        return value.new_zeros(self.num_groups).index_add_(0, self.group, value)


def _hashed(number: Tensor) -> Tensor:
    """Positive int64 that look drawn at random, of int64 (the finaliser of SplitMix64, Steele et al. 2014)."""
    mixed = (number + 1) * _GOLDEN
    for shift, factor in _MIXERS:
        mixed = (mixed ^ ((mixed >> shift) & ((1 << (64 - shift)) - 1))) * factor
    return (mixed >> 2) & ((1 << 62) - 1) | 1


def _subtree_sums(value: Tensor, parent: Tensor) -> Tensor:
    """Sums ``(N,)`` of values ``(N,)`` over each node and all nodes below it, by doubling how deep they reach."""
    reaches = parent != torch.arange(len(parent), device=parent.device)
    total = value.clone()
    ancestor = parent
    while bool(reaches.any()):
        below = reaches.nonzero().squeeze(1)
        total = total.index_add(0, ancestor[below], total[below])
        # A node reaches on if its ancestor has one as far above again.
        reaches = reaches & reaches[ancestor]
        ancestor = ancestor[ancestor]
    return total
