"""Training graphs of the SfM family."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph
from rotavg_ros.solver.message_passing import DirectedEdges


@dataclass(frozen=True)
class SfmBatch:
    """Several graphs as one disjoint graph (float32; N nodes, M edges in all).

    Attributes:
        source, target: ``(M,)``.
        measured, true_relative: ``(M, 4)`` target_from_source.
        is_outlier: ``(M,)`` bool.
        truth: ``(N, 4)`` body_from_world.
        first_node: ``(graphs + 1,)`` offsets of the graphs' nodes.
        edges: both directions of the edges.
    """

    source: Tensor
    target: Tensor
    measured: Tensor
    true_relative: Tensor
    is_outlier: Tensor
    truth: Tensor
    first_node: Tensor
    edges: DirectedEdges

    def to(self, device: torch.device) -> SfmBatch:
        edges = DirectedEdges(*(getattr(self.edges, n).to(device) for n in ("source", "target", "inverse_degree")))
        moved = {
            name: getattr(self, name).to(device)
            for name in ("source", "target", "measured", "true_relative", "is_outlier", "truth", "first_node")
        }
        return SfmBatch(**moved, edges=edges)


def sample_graph(recipe: str, nodes: tuple[int, int], rng: np.random.Generator) -> SyntheticGraph:
    """One graph of a named recipe."""
    if recipe == "mixture":
        recipe = str(rng.choice(["released", "released-spatial", "paper"], p=[0.5, 0.25, 0.25]))
    if recipe == "paper":
        # On small graphs the share of pairs grows so that a camera keeps its number of neighbours.
        denser = min(1.0, 0.3 * 500 / nodes[1])
        return PaperRecipe(cameras=nodes, pair_share=(denser / 3, denser)).sample(rng)
    return ReleasedRecipe(cameras=nodes, planar=recipe == "released").sample(rng)


def join(
    graphs: Sequence[SyntheticGraph], edge_dropout: float = 0.0, rng: np.random.Generator | None = None
) -> SfmBatch:
    """One disjoint graph; with ``edge_dropout`` > 0 every graph loses that share of its edges at random."""
    first_node = np.concatenate(([0], np.cumsum([g.graph.num_nodes for g in graphs])))
    source, target, measured, outlier = [], [], [], []
    for graph, offset in zip(graphs, first_node[:-1], strict=True):
        kept: Tensor | slice = slice(None)
        if edge_dropout > 0:
            assert rng is not None
            kept = torch.from_numpy(rng.random(graph.graph.num_edges) >= edge_dropout)
        source.append(graph.graph.source[kept] + int(offset))
        target.append(graph.graph.target[kept] + int(offset))
        measured.append(graph.graph.target_from_source[kept].float())
        outlier.append(graph.is_outlier[kept])
    sources, targets = torch.cat(source), torch.cat(target)
    truth = torch.cat([graph.body_from_world for graph in graphs]).float()
    true_relative = rotations.multiply(truth[targets], rotations.inverse(truth[sources]))
    return SfmBatch(
        sources,
        targets,
        torch.cat(measured),
        rotations.canonical(true_relative),
        torch.cat(outlier),
        truth,
        torch.from_numpy(first_node),
        DirectedEdges.of(sources, targets, len(truth)),
    )
