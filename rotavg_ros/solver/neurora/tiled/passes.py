"""Message passing for solves: the formula of ``message_passing.py`` in tiles that fit a core's cache.

Node states are projected before they are gathered. Directed edges are sorted by target and processed in tiles. An
edge's activation is overwritten in place, so that no copy of all edges is made. A tile has all edges of its nodes, so
means are complete and workers never wait for each other within a layer.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import NamedTuple, cast

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.scratch import scratch
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges, Tile
from rotavg_ros.solver.neurora.message_passing import MessagePassingLayer, MessagePassingNetwork
from rotavg_ros.solver.running.threads import for_each, stretches
from rotavg_ros.solver.running.work import stop_if_abandoned


class Tuning(NamedTuple):
    """Number of edges per tile and largest number of threads; ``tuning.py`` measures what is fastest."""

    tile_edges: int
    threads: int


_tuning = Tuning(tile_edges=8192, threads=1 << 10)

# Gets a tile, the last layer's activations of its edges ``(edges of the tile, hidden)``, and an array to write to, with
# as many numbers per edge as it has features.
Visit = Callable[[Tile, Tensor, Tensor], None]


def current_tuning() -> Tuning:
    """The present tuning of passes."""
    return _tuning


def set_tuning(tuning: Tuning) -> None:
    """Set the tuning of all passes from now on."""
    global _tuning
    _tuning = tuning


def node_states(network: MessagePassingNetwork, nodes: Tensor, features: Tensor, edges: SortedEdges) -> Tensor:
    """The last node states ``(N, hidden)``.

    Args:
        nodes: ``(N, node_width)`` initial states.
        features: ``(M, edge_width)`` float32 of the graph's edges as given; the first ``network.odd_width`` columns
            change sign where an edge is reversed.
        edges: the edges over which messages run.
    """
    with walk_over(network, features, edges) as walk:
        return walk.node_states(nodes)


def visit_activations(
    network: MessagePassingNetwork, nodes: Tensor, features: Tensor, edges: SortedEdges, visit: Visit
) -> Tensor:
    """Pass the last layer's activations to ``visit``, tile by tile and on several threads.

    The other arguments are those of :func:`node_states`.

    Returns:
        ``(E, edge_width)`` what ``visit`` has written, in the order of the sorted edges.
    """
    last = len(network.layers) - 1
    walking = walk_over(network, features, edges)
    del features
    with walking as walk:
        for layer in range(last):
            nodes = walk.layer(layer, nodes)
        walk.layer(last, nodes, visit)
        return walk.state.features


@contextmanager
def walk_over(network: MessagePassingNetwork, features: Tensor, edges: SortedEdges) -> Iterator[Walk]:
    """A pass of a network; arguments as in :func:`node_states`. Features and edges are read first, then released."""
    layers = [cast(MessagePassingLayer, layer) for layer in network.layers]
    num_edges = len(edges.source)
    with scratch(num_edges, layers[0].message_output.in_features, features) as activation:
        state = _State(activation, features.new_empty(num_edges, features.shape[1]))
        walk = Walk(layers, network.odd_width, features, edges, state)
        del features, edges  # if the caller does not hold them either, this frees memory for activations
        yield walk


class _State(NamedTuple):
    """State of E directed edges, in separate arrays, since contiguous rows are copied faster.

    Attributes:
        activation: ``(E, hidden)`` from the previous layer.
        features: ``(E, edge_width)``, with the signs of their directions.
    """

    activation: Tensor
    features: Tensor


class Walk:
    """One pass of a network over one graph.

    Args:
        features: ``(M, edge_width)``; they and the edges are read only in the constructor.
        state: working memory.
    """

    def __init__(
        self,
        layers: list[MessagePassingLayer],
        odd_width: int,
        features: Tensor,
        edges: SortedEdges,
        state: _State,
    ) -> None:
        self.layers, self.first, self.state = layers, edges.first, state
        self.hidden, self.width = state.activation.shape[1], features.shape[1]
        # Whether layers see an edge's activation from the previous layer.
        self.remembers = layers[-1].edge_projection.in_features > self.width
        on_cpu = features.device.type == "cpu"
        num_edges = len(edges.source)
        tuning = current_tuning()
        # An accelerator takes all edges at once.
        tiles = edges.tiles(tuning.tile_edges if on_cpu else max(num_edges, 1))
        self.threads = tuning.threads
        self.stretches = stretches(tiles)
        longest = max((tile.edges.stop - tile.edges.start for tile in tiles), default=0)
        self.pair_offsets = torch.arange(0, 2 * longest + 1, 2, dtype=torch.int32, device=features.device)
        self.row_numbers = torch.arange(longest, dtype=torch.int32, device=features.device)
        self.is_connected = (edges.degree > 0)[:, None]
        # The two rows that every edge sums, of the stacked projections of the node states.
        self.ends = edges.source.new_empty(num_edges, 2)
        # Signs of the features of edges as given, and of reversed edges. Every edge gets a row of signs, since torch is
        # slow at broadcasting one sign over a few columns.
        signs = features.new_ones(2, self.width)
        signs[1, :odd_width] = -1
        nodes, degree = torch.arange(edges.num_nodes, dtype=torch.int32, device=features.device), edges.degree

        def begin(tiles: Sequence[Tile]) -> None:
            for tile in tiles:
                of_edge = signs.index_select(0, edges.is_reversed[tile.edges].int())
                stated = features.index_select(0, edges.edge[tile.edges])
                torch.mul(stated, of_edge, out=state.features[tile.edges])
                count = tile.edges.stop - tile.edges.start
                target = nodes[tile.nodes].repeat_interleave(degree[tile.nodes], output_size=count)
                torch.stack((target, edges.source[tile.edges] + edges.num_nodes), dim=1, out=self.ends[tile.edges])

        for_each(begin, self.stretches, self.threads)

    def node_states(self, nodes: Tensor) -> Tensor:
        """The last node states ``(N, hidden)``, from the initial ones ``(N, node_width)``."""
        for layer in range(len(self.layers)):
            nodes = self.layer(layer, nodes)
        return nodes

    def layer(self, index: int, nodes: Tensor, visit: Visit | None = None) -> Tensor:
        """One layer; returns the new node states, or ``nodes`` if ``visit`` takes the activations instead."""
        layer = self.layers[index]
        is_last = index == len(self.layers) - 1
        # As in the specification, features come before activations.
        projection = layer.edge_projection
        weight = projection.weight.t().contiguous()
        of_features, of_activation = weight[: self.width], weight[self.width :]
        projected = None
        if layer.node_width:
            at_target = torch.addmm(projection.bias, nodes, layer.target_projection.weight.t())
            projected = torch.cat((at_target, nodes @ layer.source_projection.weight.t()))
        mean = nodes.new_zeros(len(nodes), self.hidden)
        updated = torch.empty_like(mean)

        def walk(tiles: Sequence[Tile]) -> None:
            for tile in tiles:
                stop_if_abandoned()
                before, features = self.state.activation[tile.edges], self.state.features[tile.edges]
                if projected is None:
                    activation = torch.addmm(projection.bias, features, of_features)
                else:
                    activation = self._gather_sum(tile, projected).addmm_(features, of_features)
                if len(of_activation):
                    activation.addmm_(before, of_activation)
                if self.remembers and not is_last:
                    activation = torch.clamp_min(activation, 0, out=before)  # ReLU, written to where it is remembered
                else:
                    activation.relu_()
                if visit is not None:
                    visit(tile, activation, features)
                elif len(activation):
                    mean[tile.nodes] = self._mean_by_node(tile, activation)
            if visit is None:
                rows = slice(tiles[0].nodes.start, tiles[-1].nodes.stop)
                updated[rows] = layer.update_nodes(nodes[rows], mean[rows], self.is_connected[rows])

        for_each(walk, self.stretches, self.threads)
        return nodes if visit is not None else updated

    def _gather_sum(self, tile: Tile, projected: Tensor) -> Tensor:
        """Sum of the projections of both ends, ``(edges of the tile, hidden)``."""
        ends = self.ends[tile.edges].flatten()
        return _bags(projected, ends, self.pair_offsets[: len(ends) // 2 + 1], "sum")

    def _mean_by_node(self, tile: Tile, activation: Tensor) -> Tensor:
        first = self.first[tile.nodes.start : tile.nodes.stop + 1]
        return _bags(activation, self.row_numbers[: len(activation)], first - tile.edges.start, "mean")


def _bags(table: Tensor, rows: Tensor, offsets: Tensor, mode: str) -> Tensor:
    """Sum or mean of ``table[rows[offsets[i] : offsets[i + 1]]]`` for every i; zero if it is empty.

    It is 1.5 to 20 times as fast as index_select, index_add, segment_reduce and numpy's reduceat.
    """
    result = torch.embedding_bag(
        table, rows, offsets, False, {"sum": 0, "mean": 1}[mode], False, None, include_last_offset=True
    )
    return result[0]
