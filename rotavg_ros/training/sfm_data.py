"""Training graphs of the SfM family."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe, SyntheticGraph
from rotavg_ros.datasets.simulation.topology import ClusteredTopology
from rotavg_ros.solver.algebra.canonical_form import CanonicalForm
from rotavg_ros.solver.neurora.message_passing import DirectedEdges


@dataclass(frozen=True)
class SfmBatch:
    """Several graphs as one disjoint graph (float32; N nodes, M edges in all).

    Attributes:
        source, target: ``(M,)``.
        measured, true_relative: ``(M, 4)`` target_from_source.
        is_outlier: ``(M,)`` bool.
        edges: both directions of the edges.
    """

    source: Tensor
    target: Tensor
    measured: Tensor
    true_relative: Tensor
    is_outlier: Tensor
    edges: DirectedEdges

    def to(self, device: torch.device) -> SfmBatch:
        """The same on another device."""
        edges = DirectedEdges(*(getattr(self.edges, n).to(device) for n in ("source", "target", "inverse_degree")))
        moved = {name: value.to(device) for name, value in vars(self).items() if name != "edges"}
        return SfmBatch(**moved, edges=edges)


# Recipes and their shares in the mixtures.
_MIXTURES = {
    "mixture": {"released": 0.5, "released-spatial": 0.25, "paper": 0.25},
    "broad": {"released": 0.45, "released-spatial": 0.15, "paper": 0.15, "wide": 0.25},
    "mostly-released": {"released": 0.6, "released-spatial": 0.1, "paper": 0.15, "wide": 0.15},
    "any-axes": {"released": 0.4, "released-round": 0.1, "released-spatial": 0.15, "paper": 0.15, "wide": 0.2},
}
_WIDE_NOISE_DEG = (0.2, 30.0)
_WIDE_OUTLIER_SHARE = (0.0, 0.3)


def sample_graph(recipe: str, nodes: tuple[int, int], rng: np.random.Generator) -> SyntheticGraph:
    """One graph of a named recipe."""
    if recipe in _MIXTURES:
        parts = _MIXTURES[recipe]
        recipe = str(rng.choice(list(parts), p=list(parts.values())))
    if recipe == "wide":
        return _wide_graph(nodes, rng)
    if recipe == "paper":
        # On small graphs the share of pairs grows so that a camera keeps its number of neighbours.
        denser = min(1.0, 0.3 * 500 / nodes[1])
        return PaperRecipe(cameras=nodes, pair_share=(denser / 3, denser)).sample(rng)
    return ReleasedRecipe(
        cameras=nodes, planar=recipe != "released-spatial", round_noise=recipe == "released-round"
    ).sample(rng)


def in_canonical_form(sample: SyntheticGraph) -> SyntheticGraph:
    """The same graph in the form in which solves show it to the networks."""
    form = CanonicalForm.of(sample.graph)
    noise_angle = sample.noise_angle.new_empty(form.graph.num_edges)
    noise_angle[form.edge] = sample.noise_angle
    return SyntheticGraph(form.graph, form.canonical_orientations(sample.body_from_world), noise_angle)


def _wide_graph(nodes: tuple[int, int], rng: np.random.Generator) -> SyntheticGraph:
    """A graph like real ones: noise from small to large, and mostly topologies like those of photo collections."""
    low, high = np.log(_WIDE_NOISE_DEG)
    noise_deg = float(np.exp(rng.uniform(low, high)))
    disturbed = ReleasedRecipe(
        cameras=nodes,
        noise_deg=(noise_deg, noise_deg),
        outlier_share=_WIDE_OUTLIER_SHARE,
        planar=bool(rng.random() < 0.5),
    )
    replaced = PaperRecipe(noise_deg=(noise_deg, noise_deg), outlier_share=_WIDE_OUTLIER_SHARE)
    if rng.random() < 0.25:
        return disturbed.sample(rng)
    topology = ClusteredTopology().sample(int(rng.integers(nodes[0], nodes[1] + 1)), rng)
    recipe: ReleasedRecipe | PaperRecipe = disturbed if rng.random() < 0.5 else replaced
    return topology.sample(recipe, rng)


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
        DirectedEdges.of(sources, targets, len(truth)),
    )
