"""Training of the SLAM family: the closure judge on simulated pose graphs of the wide family."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor, nn

from rotavg_ros.datasets.simulation.scarce_evidence import several_robots, slip_with_few_witnesses
from rotavg_ros.datasets.simulation.slam_simulation import random_slam_config, simulate_slam_graph
from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.metrics.calibration import expected_calibration_error
from rotavg_ros.solver.learning.closures import ClosureFeatures, SlamCleanNet, closure_inputs
from rotavg_ros.solver.neurora.message_passing import DirectedEdges
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.drawing import drawn

# Shares of the wide family's runs that have a slip spanned by few closures (elsewhere all that span it are kept), and
# that are of several robots.
_FEW_WITNESSES, _SEVERAL_ROBOTS = 0.2, 0.15


@dataclass(frozen=True)
class SlamSample:
    """One simulated graph as the network sees it.

    Attributes:
        features: features of its C closures.
        is_false: ``(C,)`` bool, true noise beyond 10°.
    """

    features: ClosureFeatures
    is_false: Tensor


def sample_run(
    nodes: tuple[int, int], rng: np.random.Generator, family: RobotFamily | None = None
) -> SlamSample | None:
    """One graph of the given family, or of the wide one; None if it has fewer than two closures."""
    keyframes = round(float(np.exp(rng.uniform(*np.log(nodes)))))
    if family is None:
        run = simulate_slam_graph(random_slam_config(rng, keyframes), rng)
        if rng.random() < _FEW_WITNESSES:
            run = slip_with_few_witnesses(run, rng)
        if rng.random() < _SEVERAL_ROBOTS:
            run = several_robots(run, rng)
        graph, is_false = run.graph, run.closure_is_false
    else:
        of_family = family.drawn(keyframes, rng)
        graph, is_false = of_family.graph, of_family.is_false
    inputs = closure_inputs(graph)
    if inputs is None:
        return None
    features, closures = inputs
    return SlamSample(features, torch.from_numpy(is_false[closures]))


def join(samples: Sequence[SlamSample]) -> SlamSample:
    """Several graphs as one disjoint graph."""
    offsets = np.concatenate(([0], np.cumsum([len(sample.is_false) for sample in samples])))
    source, target = (
        torch.cat([getattr(s.features.edges, end) + int(o) for s, o in zip(samples, offsets, strict=False)])
        for end in ("source", "target")
    )
    edges = DirectedEdges(source, target, torch.cat([s.features.edges.inverse_degree for s in samples]))
    closures = torch.cat([s.features.closures for s in samples])
    pairs = torch.cat([s.features.pairs for s in samples])
    return SlamSample(ClosureFeatures(closures, pairs, edges), torch.cat([s.is_false for s in samples]))


class SlamCleanTask:
    """SlamCleanNet: classifies closures as false or good.

    The loss is the mean cross-entropy over all closures of a batch: a graph has a weight in proportion to its closures.
    Validation averages over graphs.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self.config = config
        family = (config.robots or RobotFamily()) if config.recipe == "robots" else None
        self.samples = _draw(config.graphs, config.nodes, np.random.default_rng((config.seed, 1)), family)
        self.validation = _draw(
            config.validation_graphs, config.validation_nodes, np.random.default_rng((config.seed, 2)), family
        )
        torch.manual_seed(config.seed)
        self.network = SlamCleanNet()

    def num_batches(self) -> int:
        return -(-len(self.samples) // self.config.batch_graphs)

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        order = rng.permutation(len(self.samples))
        for start in range(0, len(order), self.config.batch_graphs):
            batch = join([self.samples[index] for index in order[start : start + self.config.batch_graphs]])
            yield {"loss": _loss(self.network(_drop_pairs(batch.features, self.config.edge_dropout, rng)), batch)}

    def validate(self) -> dict[str, float]:
        logits, labels, losses = [], [], []
        for sample in self.validation:
            logit = self.network(sample.features)
            losses.append(float(_loss(logit, sample)))
            logits.append(logit)
            labels.append(sample.is_false)
        logit, label = torch.cat(logits), torch.cat(labels)
        return {
            "objective": float(np.mean(losses)),
            "accuracy": float(((logit > 0) == label).float().mean()),
            "ece": expected_calibration_error(torch.sigmoid(logit), label),
        }


def _draw(count: int, nodes: tuple[int, int], rng: np.random.Generator, family: RobotFamily | None) -> list[SlamSample]:
    lack = "they have fewer than two closures; longer ones or more closures would help"
    return drawn(count, lambda: sample_run(nodes, rng, family), lack)


def _loss(logit: Tensor, sample: SlamSample) -> Tensor:
    return nn.functional.binary_cross_entropy_with_logits(logit, sample.is_false.to(logit))


def _drop_pairs(features: ClosureFeatures, share: float, rng: np.random.Generator) -> ClosureFeatures:
    """Leave out a share of the agreement pairs, so that no closure relies on one neighbour."""
    kept = torch.from_numpy(rng.random(len(features.pairs)) >= share)
    source, target = features.edges.source[kept], features.edges.target[kept]
    degree = torch.bincount(target, minlength=len(features.closures))
    inverse_degree = torch.where(degree > 0, 1 / degree.clamp(min=1).float(), 0.0)[:, None]
    return ClosureFeatures(features.closures, features.pairs[kept], DirectedEdges(source, target, inverse_degree))
