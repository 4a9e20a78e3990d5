"""The paper's stages on an SfM view-graph, as the pipeline runs them."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from rotavg_ros.solver.algebra.sorted_edges import SortedEdges
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.tiled.networks import clean_edges, fine_tuned
from rotavg_ros.view_graph import EdgeLabel, ViewGraph


def clean(network: CleanNet, graph: ViewGraph) -> Cleaned:
    """CleanNet, without gradients: rectify every measurement and score it.

    The network may be on another device than the graph; the result is on the graph's.
    """
    device = next(network.parameters()).device
    edges = SortedEdges.of(graph)
    with torch.no_grad():
        result = clean_edges(network, graph.target_from_source.to(device), edges.to(device))
        probability = torch.sigmoid(result.outlier_logit).to(graph.device)
    rectified = replace(graph, target_from_source=result.target_from_source.to(graph.device))
    return Cleaned(rectified, graph, probability, edges)


def trust_all(graph: ViewGraph) -> Cleaned:
    """Stands in for CleanNet in methods without it: keeps every measurement as it is."""
    nobody = torch.zeros(graph.num_edges, device=graph.device)
    return Cleaned(graph, graph, nobody, SortedEdges.of(graph))


def apply_labels(cleaned: Cleaned, label: Tensor) -> Cleaned:
    """Verdicts from outside override the network's."""
    return replace(cleaned, outlier_probability=labelled(cleaned.outlier_probability, label))


def labelled(probability: Tensor, label: Tensor) -> Tensor:
    """Probabilities ``(M,)`` that edges are false, overridden by labels ``(M,)``."""
    probability = torch.where(label == EdgeLabel.ACCEPTED, 0.0, probability)
    return torch.where(label == EdgeLabel.REJECTED, 1.0, probability)


@torch.no_grad()
def fine_tune(network: FineNet, cleaned: Cleaned, body_from_world: Tensor, component: Tensor | None = None) -> Tensor:
    """FineNet over the inlier edges, without gradients, ``(N, 4)`` float64.

    The network may be on another device than the graph; the result is on the graph's.

    Args:
        component: ``(N,)`` the graph's connected components; default: computed.
    """
    component = cleaned.graph.components() if component is None else component
    device = next(network.parameters()).device
    fine = fine_tuned(network, cleaned.to(device), body_from_world.float().to(device), component.to(device))
    return fine.double().to(cleaned.graph.device)
