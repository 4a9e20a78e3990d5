"""CleanNet and FineNet as solves run them: what their ``forward`` computes, by the tiled passes of ``inference.py``."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from rotavg_ros.solver.clean_net import CleanEdges, CleanNet
from rotavg_ros.solver.fine_net import FineNet
from rotavg_ros.solver.inference import node_states, visit_activations
from rotavg_ros.solver.message_passing import MessagePassingLayer
from rotavg_ros.solver.parallel import for_each, slices
from rotavg_ros.solver.residuals import SLICE_EDGES, EdgeResiduals, multiply_rows
from rotavg_ros.solver.sorted_edges import SortedEdges, Tile
from rotavg_ros.view_graph import ViewGraph


def clean_edges(network: CleanNet, target_from_source: Tensor, edges: SortedEdges) -> CleanEdges:
    """What CleanNet says of the measurements ``(M, 4)`` float32; ``edges`` are all of the graph's."""
    num_edges = len(target_from_source)
    # Rows: predicted noise (4), outlier logit (1). Columns: the edges as given, then the same edges reversed.
    opinion = target_from_source.new_empty(5, 2 * num_edges)
    # The heads are linear in the message, and that is linear in the activation.
    last = cast(MessagePassingLayer, network.network.layers[-1]).message_output
    head = torch.cat((network.noise_head.weight, network.outlier_head.weight))
    bias = head @ last.bias + torch.cat((network.noise_head.bias, network.outlier_head.bias))
    weight = head @ last.weight

    def collect(tile: Tile, activation: Tensor) -> None:
        column = edges.edge[tile.edges].long() + num_edges * edges.is_reversed[tile.edges]
        opinion.index_copy_(1, column, torch.addmm(bias[:, None], weight, activation.t()))

    no_states = target_from_source.new_zeros(edges.num_nodes, 0)
    visit_activations(network.network, no_states, target_from_source, edges, collect)
    clean = torch.empty_like(target_from_source)
    logit = target_from_source.new_empty(num_edges)

    def decide(part: slice) -> None:
        measured = target_from_source[part].t().contiguous()
        forward, backward = opinion[:, part], opinion[:, num_edges + part.start : num_edges + part.stop]
        # CleanNet.correct, multiplied out: R̃ (1 + (f + R̃⁻¹ b⁻¹ R̃) / 2) = R̃ + (R̃ f + b⁻¹ R̃) / 2.
        inverse_backward = torch.cat((-backward[:3], backward[3:4]))
        change = multiply_rows(measured, forward[:4]) + multiply_rows(inverse_backward, measured)
        corrected = torch.nn.functional.normalize(measured + change / 2, dim=0)
        clean[part] = corrected.mul_(1 - 2 * (corrected[3] < 0).to(corrected)).t()
        logit[part] = (forward[4] + backward[4]) / 2

    for_each(decide, slices(num_edges, SLICE_EDGES, logit.device))
    return CleanEdges(clean, logit)


def fine_tuned(network: FineNet, graph: ViewGraph, body_from_world: Tensor, edges: SortedEdges) -> Tensor:
    """FineNet's correction of ``body_from_world`` ``(N, 4)`` float32 over the ``edges`` of ``graph``."""
    residuals = EdgeResiduals(graph, body_from_world)
    features = body_from_world.new_empty(graph.num_edges, 4)

    def write(part: slice) -> None:
        features[part] = residuals.quaternions(part).t()

    for_each(write, slices(graph.num_edges, SLICE_EDGES, features.device))
    return network.correct(body_from_world, node_states(network.network, body_from_world, features, edges))
