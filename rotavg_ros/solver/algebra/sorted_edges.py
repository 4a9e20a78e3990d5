"""Both directions of a view-graph's edges, sorted by the node at which they arrive, for tiled passes."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from scipy.sparse import csr_array
from torch import Tensor

from rotavg_ros.solver.running.threads import for_each, slices
from rotavg_ros.view_graph import ViewGraph

# Rows that a thread writes at a time.
_SLICE_EDGES = 1 << 16


class Tile(NamedTuple):
    """Neighbouring nodes and all edges that arrive at them."""

    nodes: slice
    edges: slice


@dataclass(frozen=True)
class SortedEdges:
    """Both directions of a graph's M edges, E = 2M, or of some of them; all tensors are on one device.

    Attributes:
        first: ``(N + 1,)`` int32: rows ``first[v] … first[v+1] - 1`` arrive at node v.
        source: ``(E,)`` int32, the node from which each comes; at each node, in the order of the graph's edges.
        edge: ``(E,)`` int32, the graph's edge.
        is_reversed: ``(E,)`` bool, whether it runs against that edge's direction.
    """

    first: Tensor
    source: Tensor
    edge: Tensor
    is_reversed: Tensor

    @classmethod
    def of(cls, graph: ViewGraph) -> SortedEdges:
        num_edges = graph.num_edges
        first, order = sorted_by_node(torch.cat((graph.target.int(), graph.source.int())), graph.num_nodes)
        begins = torch.cat((graph.source.int(), graph.target.int()))
        source, is_reversed = torch.empty_like(order), torch.empty_like(order, dtype=torch.bool)

        def write(part: slice) -> None:
            torch.index_select(begins, 0, order[part], out=source[part])
            torch.ge(order[part], num_edges, out=is_reversed[part])
            order[part] %= num_edges

        for_each(write, slices(len(order), _SLICE_EDGES, order.device))
        return cls(first, source, order, is_reversed)

    @property
    def num_nodes(self) -> int:
        return len(self.first) - 1

    @property
    def degree(self) -> Tensor:
        """``(N,)`` int32, edges that arrive; parallel ones count."""
        return self.first.diff()

    def to(self, device: torch.device | str) -> SortedEdges:
        """The same on another device."""
        return SortedEdges(*(getattr(self, field.name).to(device) for field in fields(self)))

    def target(self) -> Tensor:
        """``(E,)`` int32, the node at which each edge arrives."""
        nodes = torch.arange(self.num_nodes, dtype=torch.int32, device=self.first.device)
        return nodes.repeat_interleave(self.degree, output_size=len(self.source))

    def select(self, kept: Tensor) -> SortedEdges:
        """Those of the graph's edges that ``kept`` ``(M,)`` bool marks; edge numbers stay the whole graph's."""
        chosen = kept.index_select(0, self.edge)
        first = torch.cat((chosen.new_zeros(1, dtype=torch.int32), chosen.cumsum(0, dtype=torch.int32)))[self.first]
        rows = chosen.nonzero().squeeze(1)
        columns = (self.source, self.edge, self.is_reversed)
        selected = tuple(column.new_empty(len(rows)) for column in columns)

        def write(part: slice) -> None:
            for column, into in zip(columns, selected, strict=True):
                torch.index_select(column, 0, rows[part], out=into[part])

        for_each(write, slices(len(rows), _SLICE_EDGES, rows.device))
        return SortedEdges(first, *selected)

    def tiles(self, num_edges: int) -> list[Tile]:
        """All nodes in order, cut into tiles of about ``num_edges`` edges; a node's edges are never split."""
        if len(self.source) <= num_edges and self.num_nodes:  # so on an accelerator; nothing needs to be read back
            return [Tile(slice(0, self.num_nodes), slice(0, len(self.source)))]
        first = self.first.cpu().numpy()
        cuts = np.searchsorted(first, np.arange(0, first[-1], num_edges), side="left")
        nodes = np.unique(np.concatenate(([0], cuts, [self.num_nodes])))
        edges = first[nodes]
        bounds = zip(nodes[:-1].tolist(), nodes[1:].tolist(), edges[:-1].tolist(), edges[1:].tolist(), strict=True)
        return [Tile(slice(low, high), slice(start, end)) for low, high, start, end in bounds]


def sorted_by_node(arrival: Tensor, num_nodes: int) -> tuple[Tensor, Tensor]:
    """Edges sorted by the node at which they arrive: where each node's begin ``(N + 1,)``, and the order; int32."""
    if arrival.device.type == "cpu" and 0 < len(arrival) < 2**31:
        # Transposing a matrix with one entry in every row is a counting sort: a quarter of the time of torch's.
        edge = np.arange(len(arrival) + 1, dtype=np.int32)
        by_node = csr_array((edge[:-1], arrival.numpy(), edge), shape=(len(arrival), num_nodes)).tocsc()
        return torch.from_numpy(by_node.indptr), torch.from_numpy(by_node.indices)
    count = torch.bincount(arrival, minlength=num_nodes)
    return torch.cat((count.new_zeros(1), count.cumsum(0))).int(), arrival.sort(stable=True).indices.int()
