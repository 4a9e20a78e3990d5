"""Training of the networks as in the paper's text: graphs as drawn, its tree, its losses (NeuRoRA §4)."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import SyntheticGraph
from rotavg_ros.solver.algebra.residuals import edge_residual
from rotavg_ros.solver.neurora.cleaned import Cleaned
from rotavg_ros.solver.neurora.message_passing import DirectedEdges
from rotavg_ros.solver.neurora.paper import PaperCleanNet, PaperFineNet, paper_fine_tune
from rotavg_ros.solver.neurora.stages import clean
from rotavg_ros.solver.neurora.tree import breadth_first
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.fine_data import validated
from rotavg_ros.training.losses import paper_fine_net_loss
from rotavg_ros.training.sfm_tasks import GivenGraphs, SfmCleanTask, drawn_graphs


class PaperCleanTask(SfmCleanTask):
    """CleanNet as in the paper; the loss is the same as for this package's own, which is the paper's."""

    KIND = PaperCleanNet
    CANONICAL = False


@dataclass(frozen=True)
class RootedGraph:
    """A graph at the start of the paper's FineNet (N nodes).

    Attributes:
        cleaned: CleanNet's output.
        start: ``(N, 4)`` float64, the orientations of the breadth-first tree, whose root is at the identity.
        truth: ``(N, 4)`` float64, in the same gauge.
    """

    cleaned: Cleaned
    start: Tensor
    truth: Tensor

    @classmethod
    def of(cls, clean_net: PaperCleanNet, graph: SyntheticGraph) -> RootedGraph:
        begun = breadth_first(clean(clean_net, graph.graph))
        gauge = rotations.inverse(graph.body_from_world[begun.roots[:1]])
        truth = rotations.canonical(rotations.multiply(graph.body_from_world, gauge))
        return cls(begun.cleaned, rotations.canonical(begun.body_from_world), truth)


class PaperFineTask:
    """FineNet as in the paper, after the paper's CleanNet and tree (loss: edge + 0.1 · node)."""

    def __init__(
        self,
        config: TrainingConfig,
        device: torch.device,
        clean_net: PaperCleanNet,
        given: GivenGraphs | None = None,
    ) -> None:
        self.config, self.device = config, device
        torch.manual_seed(config.seed)
        self.network = PaperFineNet().to(device)
        clean_net = clean_net.to(device).eval()
        drawn = given if given is not None else drawn_graphs(config)
        self._graphs, self._validation = ([RootedGraph.of(clean_net, graph) for graph in graphs] for graphs in drawn)

    def num_batches(self) -> int:
        return -(-len(self._graphs) // self.config.batch_graphs)

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        order = rng.permutation(len(self._graphs))
        for first in range(0, len(order), self.config.batch_graphs):
            chosen = [self._graphs[index] for index in order[first : first + self.config.batch_graphs]]
            yield self._loss(chosen, rng)

    def _loss(self, graphs: Sequence[RootedGraph], rng: np.random.Generator) -> dict[str, Tensor]:
        """Loss of several graphs as one disjoint graph of inlier edges, a share of which is left out at random."""
        source, target, rectified = [], [], []
        offset = 0
        for graph in graphs:
            kept = graph.cleaned.is_inlier.nonzero().squeeze(1)
            kept = kept[torch.from_numpy(rng.random(len(kept)) >= self.config.edge_dropout)]
            source.append(graph.cleaned.graph.source[kept] + offset)
            target.append(graph.cleaned.graph.target[kept] + offset)
            rectified.append(graph.cleaned.graph.target_from_source[kept])
            offset += len(graph.start)
        sources, targets = (torch.cat(ends).to(self.device) for ends in (source, target))
        start, truth = (
            torch.cat([getattr(graph, name) for graph in graphs]).float().to(self.device) for name in ("start", "truth")
        )
        measured = torch.cat(rectified).float().to(self.device)
        residual = rotations.canonical(edge_residual(start, measured, sources, targets))
        edges = DirectedEdges.of(sources, targets, offset)
        return paper_fine_net_loss(self.network(start, residual, edges), truth, edges)

    def validate(self) -> dict[str, float]:
        return validated(self._validation, partial(paper_fine_tune, self.network))
