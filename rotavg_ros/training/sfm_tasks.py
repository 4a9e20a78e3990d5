"""Training of the SfM family: CleanNet on measurements, FineNet on what CleanNet and the tree leave."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.synthetic import SyntheticGraph
from rotavg_ros.evaluation.metrics import gauge_alignment, orientation_errors
from rotavg_ros.solver.clean_net import CleanNet
from rotavg_ros.solver.fine_net import FineNet
from rotavg_ros.solver.message_passing import DirectedEdges
from rotavg_ros.solver.sfm_stages import bootstrap, clean, fine_tune
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.losses import clean_net_loss, fine_net_loss, quaternion_distance
from rotavg_ros.training.sfm_data import SfmBatch, join, sample_graph
from rotavg_ros.view_graph import ViewGraph


class GivenGraphs(NamedTuple):
    """Graphs to train on in place of drawn ones."""

    training: Sequence[SyntheticGraph]
    validation: Sequence[SyntheticGraph]


def _draw(config: TrainingConfig) -> GivenGraphs:
    rng = np.random.default_rng((config.seed, 1))
    training = [sample_graph(config.recipe, config.nodes, rng) for _ in range(config.graphs)]
    rng = np.random.default_rng((config.seed, 2))
    validation = [sample_graph(config.recipe, config.validation_nodes, rng) for _ in range(config.validation_graphs)]
    return GivenGraphs(training, validation)


class _SfmTask:
    """Training and validation graphs: drawn once from the configuration's seed, or given."""

    def __init__(self, config: TrainingConfig, given: GivenGraphs | None) -> None:
        self.config = config
        self.graphs, self.validation = given if given is not None else _draw(config)

    def num_batches(self) -> int:
        return -(-len(self.graphs) // self.config.batch_graphs)

    def _joined_batches(self, rng: np.random.Generator) -> Iterator[SfmBatch]:
        order = rng.permutation(len(self.graphs))
        for start in range(0, len(order), self.config.batch_graphs):
            chosen = [self.graphs[index] for index in order[start : start + self.config.batch_graphs]]
            yield join(chosen, self.config.edge_dropout, rng)


class SfmCleanTask(_SfmTask):
    """CleanNet: rectify and score (loss: rotation + 10 · outlier)."""

    def __init__(self, config: TrainingConfig, device: torch.device, given: GivenGraphs | None = None) -> None:
        super().__init__(config, given)
        self.device = device
        torch.manual_seed(config.seed)
        self.network = CleanNet().to(device)

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        for joined in self._joined_batches(rng):
            batch = joined.to(self.device)
            result = self.network(batch.measured, batch.edges)
            yield clean_net_loss(
                result.target_from_source, result.outlier_logit, batch.true_relative, batch.is_outlier, batch.edges
            )

    def validate(self) -> dict[str, float]:
        rows = []
        for graph in self.validation:
            batch = join([graph]).to(self.device)
            result = self.network(batch.measured, batch.edges)
            terms = clean_net_loss(
                result.target_from_source, result.outlier_logit, batch.true_relative, batch.is_outlier, batch.edges
            )
            inliers = ~batch.is_outlier
            before = rotations.angle_between(batch.measured, batch.true_relative)[inliers]
            after = rotations.angle_between(result.target_from_source, batch.true_relative)[inliers]
            accuracy = ((result.outlier_logit > 0) == batch.is_outlier).float().mean()
            rows.append(
                [float(terms["loss"]), float(accuracy), *(float(torch.rad2deg(x.mean())) for x in (before, after))]
            )
        names = ("objective", "accuracy", "inlier_deg_before", "inlier_deg_after")
        return dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))


class SfmFineTask(_SfmTask):
    """FineNet: starts from a trained CleanNet's tree (loss: edge + 0.1 · node)."""

    def __init__(
        self, config: TrainingConfig, device: torch.device, clean_net: CleanNet, given: GivenGraphs | None = None
    ) -> None:
        super().__init__(config, given)
        self.device = device
        torch.manual_seed(config.seed)
        self.network = FineNet().to(device)
        self.clean_net = clean_net.to(device).eval()

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        for batch in self._joined_batches(rng):
            passes, start, edges = self._forward(batch.to(self.device))
            truth = _align(batch, start).to(self.device)
            source, target = batch.source.to(self.device), batch.target.to(self.device)
            terms = [fine_net_loss(fine.float(), truth, source, target, edges) for fine in passes]
            yield {key: torch.stack([of_pass[key] for of_pass in terms]).mean() for key in terms[0]}

    def _forward(self, batch: SfmBatch) -> tuple[list[Tensor], Tensor, DirectedEdges]:
        """Orientations after every pass, and the tree's."""
        graph = ViewGraph.create(batch.source, batch.target, batch.measured.double(), num_nodes=len(batch.truth))
        with torch.no_grad():
            cleaned = clean(self.clean_net, graph)
            start, _ = bootstrap(cleaned)
        fine, passes = start.to(self.device), []
        for _ in range(self.config.passes):
            fine = fine_tune(self.network, cleaned, fine)
            passes.append(fine)
        return passes, start.cpu(), batch.edges

    def validate(self) -> dict[str, float]:
        rows = []
        for graph in self.validation:
            batch = join([graph])
            passes, start, _ = self._forward(batch.to(self.device))
            errors = [torch.rad2deg(orientation_errors(x.cpu(), graph.body_from_world)) for x in (start, passes[-1])]
            distance = [quaternion_distance(x.cpu(), _align(batch, x.cpu().double())).mean() for x in passes]
            objective = float(torch.stack(distance).mean())
            rows.append([objective, *(float(f(e)) for e in errors for f in (torch.mean, torch.median))])
        names = ("objective", "tree_mean_deg", "tree_median_deg", "mean_deg", "median_deg")
        return dict(zip(names, np.mean(rows, axis=0).tolist(), strict=True))


def _align(batch: SfmBatch, start: Tensor) -> Tensor:
    """The truth in the gauge of ``start``, graph by graph, ``(N, 4)`` float32."""
    truth = batch.truth.cpu().double()
    offsets = batch.first_node.tolist()
    aligned = [
        rotations.multiply(truth[low:high], gauge_alignment(start[low:high].double(), truth[low:high]))
        for low, high in pairwise(offsets)
    ]
    return rotations.canonical(torch.cat(aligned)).float()
