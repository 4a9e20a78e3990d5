"""Training of the SfM family: CleanNet on measurements, FineNet on the result of CleanNet and the tree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
import torch
from torch import Tensor

from rotavg_ros import rotations
from rotavg_ros.datasets.simulation.synthetic import SyntheticGraph
from rotavg_ros.solver.neurora.clean_net import CleanNet
from rotavg_ros.solver.neurora.fine_net import FineNet
from rotavg_ros.solver.neurora.stages import fine_tune
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.fine_data import FineBatch, StartedGraph, validated
from rotavg_ros.training.losses import clean_net_loss, fine_net_loss
from rotavg_ros.training.sfm_data import SfmBatch, in_canonical_form, join, sample_graph


class GivenGraphs(NamedTuple):
    """Graphs to train on instead of drawn ones."""

    training: Sequence[SyntheticGraph]
    validation: Sequence[SyntheticGraph]


def drawn_graphs(config: TrainingConfig) -> GivenGraphs:
    """The graphs that a configuration's seed gives."""
    rng = np.random.default_rng((config.seed, 1))
    training = [sample_graph(config.recipe, config.nodes, rng) for _ in range(config.graphs)]
    rng = np.random.default_rng((config.seed, 2))
    validation = [sample_graph(config.recipe, config.validation_nodes, rng) for _ in range(config.validation_graphs)]
    return GivenGraphs(training, validation)


class _SfmTask:
    """Training and validation graphs: drawn once from the configuration's seed, or given.

    Attributes:
        CANONICAL: networks see them in canonical form.
    """

    CANONICAL: ClassVar[bool] = True

    def __init__(self, config: TrainingConfig, given: GivenGraphs | None) -> None:
        self.config = config
        drawn = given if given is not None else drawn_graphs(config)
        if self.CANONICAL:
            drawn = GivenGraphs(*([in_canonical_form(graph) for graph in graphs] for graphs in drawn))
        self.graphs, self.validation = drawn

    def num_batches(self) -> int:
        return -(-len(self.graphs) // self.config.batch_graphs)

    def _joined_batches(self, rng: np.random.Generator) -> Iterator[SfmBatch]:
        order = rng.permutation(len(self.graphs))
        for start in range(0, len(order), self.config.batch_graphs):
            chosen = [self.graphs[index] for index in order[start : start + self.config.batch_graphs]]
            yield join(chosen, self.config.edge_dropout, rng)


class SfmCleanTask(_SfmTask):
    """CleanNet: rectify and score (loss: rotation + 10 · outlier)."""

    KIND: ClassVar[type[CleanNet]] = CleanNet

    def __init__(self, config: TrainingConfig, device: torch.device, given: GivenGraphs | None = None) -> None:
        super().__init__(config, given)
        self.device = device
        torch.manual_seed(config.seed)
        self.network = self.KIND().to(device)

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
    """FineNet: starts from a trained CleanNet's tree (loss: edge + node)."""

    def __init__(
        self, config: TrainingConfig, device: torch.device, clean_net: CleanNet, given: GivenGraphs | None = None
    ) -> None:
        super().__init__(config, given)
        self.device = device
        torch.manual_seed(config.seed)
        self.network = FineNet().to(device)
        clean_net = clean_net.to(device).eval()
        self._started = [StartedGraph.of(clean_net, graph) for graph in self.graphs]
        self._validation_started = [StartedGraph.of(clean_net, graph) for graph in self.validation]
        # Odds of the number of passes before the one that is learned from: fewer are more likely.
        odds = 1 / np.arange(1, config.passes + 1)
        self._odds = odds / odds.sum()

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        order = rng.permutation(len(self._started))
        for first in range(0, len(order), self.config.batch_graphs):
            chosen = [self._started[index] for index in order[first : first + self.config.batch_graphs]]
            batch = FineBatch.of(chosen, self.config.edge_dropout, rng).to(self.device)
            start = batch.start
            with torch.no_grad():
                for _ in range(int(rng.choice(len(self._odds), p=self._odds))):
                    start, _ = batch.fine_tune(self.network, start)
            fine, scale = batch.fine_tune(self.network, start)
            yield fine_net_loss(fine, batch.truth, scale, batch.graph, batch.edges)

    def validate(self) -> dict[str, float]:
        return validated(self._validation_started, partial(fine_tune, self.network))
