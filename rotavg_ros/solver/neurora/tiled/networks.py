"""CleanNet and FineNet as solves run them: what their ``forward`` computes, by the tiled passes of ``passes.py``."""

from __future__ import annotations

from typing import cast

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.medians import median_by_group
from rotavg_ros.solver.algebra.residuals import SLICE_EDGES, EdgeResiduals, multiply_rows
from rotavg_ros.solver.algebra.sorted_edges import SortedEdges, Tile
from rotavg_ros.solver.neurora.clean_net import CleanEdges, CleanNet
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.fine_net import (
    EVEN_FEATURES,
    ODD_FEATURES,
    FineNet,
    edge_features,
    node_features,
)
from rotavg_ros.solver.neurora.message_passing import MessagePassingLayer
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.neurora.tiled.passes import visit_activations, walk_over
from rotavg_ros.solver.running.threads import for_each, slices


def clean_edges(network: CleanNet, target_from_source: Tensor, edges: SortedEdges) -> CleanEdges:
    """CleanNet's result for measurements ``(M, 4)``, in its own precision; ``edges`` are all edges of the graph."""
    num_edges, like = len(target_from_source), network.noise_head.weight
    # In the order of the sorted edges.
    directed_logit = like.new_empty(2 * num_edges)
    # The heads are linear in the message, and that is linear in the activation.
    last = cast(MessagePassingLayer, network.network.layers[-1]).message_output
    head = torch.cat((network.noise_head.weight, network.outlier_head.weight))
    bias = head @ last.bias + torch.cat((network.noise_head.bias, network.outlier_head.bias))
    weight = head @ last.weight

    def collect(tile: Tile, activation: Tensor, noise: Tensor) -> None:
        opinion = torch.addmm(bias[:, None], weight, activation.t())
        noise.copy_(opinion[:4].t())
        directed_logit[tile.edges] = opinion[4]

    no_states = like.new_zeros(edges.num_nodes, 0)
    # Predicted noise overwrites the measurements, since both have four numbers.
    noise = visit_activations(network.network, no_states, target_from_source.to(like.dtype), edges, collect)
    # Row of the result for each edge as it was given, then for the same edge reversed.
    place = edges.edge.new_empty(2 * num_edges)
    clean, logit = like.new_empty(num_edges, 4), like.new_empty(num_edges)

    def find(part: slice) -> None:
        row = edges.edge[part] + num_edges * edges.is_reversed[part]
        place.index_copy_(0, row, torch.arange(part.start, part.stop, dtype=torch.int32, device=row.device))

    for_each(find, slices(2 * num_edges, SLICE_EDGES, place.device))

    def decide(part: slice) -> None:
        measured = target_from_source[part].to(like.dtype).t().contiguous()
        rows = [direction[part] for direction in place.view(2, -1)]
        forward, backward = (noise.index_select(0, row).t().contiguous() for row in rows)
        # clean_net.correct, multiplied out: R̃ (1 + (f + R̃⁻¹ b⁻¹ R̃) / 2) = R̃ + (R̃ f + b⁻¹ R̃) / 2.
        inverse_backward = torch.cat((-backward[:3], backward[3:4]))
        change = multiply_rows(measured, forward) + multiply_rows(inverse_backward, measured)
        corrected = torch.add(measured, change, alpha=0.5)
        # Unit length and w ≥ 0; torch's normalize takes twenty times as long over rows.
        scale = (corrected * corrected).sum(dim=0).rsqrt_().mul_(1 - 2 * (corrected[3] < 0).to(corrected))
        clean[part] = (corrected * scale).t()
        logit[part] = (directed_logit.index_select(0, rows[0]) + directed_logit.index_select(0, rows[1])) / 2

    for_each(decide, slices(num_edges, SLICE_EDGES, logit.device))
    return CleanEdges(clean, logit)


def fine_tuned(network: FineNet, cleaned: Cleaned, body_from_world: Tensor, component: Tensor) -> Tensor:
    """FineNet's correction of ``body_from_world`` ``(N, 4)`` float32; messages run over the inliers.

    Args:
        component: ``(N,)`` connected components.
    """
    scale, features = _scale_and_features(cleaned, body_from_world, component)
    edges = cleaned.edges.select(cleaned.is_inlier)
    states = node_features(body_from_world, edges.degree[:, None])
    with walk_over(network.network, features, edges) as walk:
        del features, edges  # frees memory for activations
        states = walk.node_states(states)
    return network.correct(body_from_world, states, scale)


def _scale_and_features(cleaned: Cleaned, body_from_world: Tensor, component: Tensor) -> tuple[Tensor, Tensor]:
    """The unit of residuals from :func:`typical_size`, and the edges' features ``(M, …)``."""
    measured, is_inlier = cleaned.measured, cleaned.is_inlier
    num_edges = measured.num_edges
    residuals = [EdgeResiduals(graph, body_from_world) for graph in (measured, cleaned.graph)]
    raw, clean = (body_from_world.new_empty(3, num_edges) for _ in residuals)

    def compare(part: slice) -> None:
        for vectors, of_kind in zip((raw, clean), residuals, strict=True):
            vectors[:, part] = of_kind.quaternions(part)[:3]

    parts = slices(num_edges, SLICE_EDGES, raw.device)
    for_each(compare, parts)
    used = is_inlier.nonzero().squeeze(1)
    scale = typical_size(raw.index_select(1, used), measured.source.index_select(0, used), component)
    features = raw.new_empty(num_edges, ODD_FEATURES + EVEN_FEATURES)

    def write(part: slice) -> None:
        unit = scale[measured.source[part], 0] if len(scale) > 1 else scale[0]
        logit = cleaned.outlier_probability[part].logit()
        features[part] = edge_features(raw[:, part], clean[:, part], logit, unit).t()

    for_each(write, parts)
    return scale, features


def typical_size(vectors: Tensor, node: Tensor, group_of_node: Tensor) -> Tensor:
    """Median length of the vectors ``(3, k)`` of a node's group, ``(N, 1)``, or ``(1, 1)`` if there is only one.

    Args:
        node: ``(k,)`` node of every vector.
        group_of_node: ``(N,)``.
    """
    length = (vectors * vectors).sum(dim=0).sqrt_()
    if not bool((group_of_node > 0).any()):
        return (
            (length.median() if len(length) else length.new_tensor(0.0)).clamp(min=NUMBERS.min_residual).reshape(1, 1)
        )
    median = median_by_group(length, group_of_node[node], int(group_of_node.max()) + 1)
    return torch.where(median.isfinite(), median, 0.0).clamp(min=NUMBERS.min_residual)[group_of_node][:, None]
