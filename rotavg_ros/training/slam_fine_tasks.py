"""Training of FineNet of the SLAM profile: how far edges err, end to end through the sparse solve."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.solver.fine_tuning import SlamFineNet, SolvedRun, losses_of, solved_run
from rotavg_ros.training.config import TrainingConfig

# A nat per edge by which its variance differs from the true one counts as so much of the logarithm of the mean error:
# single drawings' errors say little of what weights are worth, all their edges together much.
NATS_WEIGHT = 0.3
# From this epoch on such a share of the runs is shown as it is after FineNet was applied once, so that it learns to be
# applied twice.
_SECOND_FROM, _SECOND_SHARE = 2, 0.4


class SlamFineTask:
    """SlamFineNet on solved runs of a family, each counting the same."""

    def __init__(self, config: TrainingConfig) -> None:
        self.config = config
        family = config.robots or RobotFamily()
        self.runs = draw_runs(family, config.graphs, config.nodes, np.random.default_rng((config.seed, 3)))
        self.validation = draw_runs(
            family, config.validation_graphs, config.validation_nodes, np.random.default_rng((config.seed, 4))
        )
        torch.manual_seed(config.seed)
        self.network = SlamFineNet()
        self._epoch = 0

    def num_batches(self) -> int:
        return -(-len(self.runs) // self.config.batch_graphs)

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        order = rng.permutation(len(self.runs))
        share = _SECOND_SHARE if self.config.passes > 1 else 0.0
        for start in range(0, len(order), self.config.batch_graphs):
            runs = [self.runs[index] for index in order[start : start + self.config.batch_graphs]]
            samples = [run.again(self.network) if rng.random() < share else run.first for run in runs]
            error, nats = (values.mean() for values in losses_of(self.network, samples))
            yield {"loss": error + NATS_WEIGHT * nats, "log_error": error, "nats": nats}

    def validate(self) -> dict[str, float]:
        """The mean logarithm of the error over that without FineNet, after one pass and two."""
        once, nats = losses_of(self.network, [run.first for run in self.validation])
        before = torch.stack([run.first.losses(torch.zeros_like(run.first.used))[0] for run in self.validation])
        again, _ = losses_of(self.network, [run.again(self.network) for run in self.validation])
        gained = float((again - before).mean()) if self.config.passes > 1 else float((once - before).mean())
        return {"objective": gained, "once": float((once - before).mean()), "nats": float(nats.mean())}


def draw_runs(
    family: RobotFamily, count: int, nodes: tuple[int, int], rng: np.random.Generator
) -> list[SolvedRun]:
    """So many runs that were solved well enough to learn from."""
    runs: list[SolvedRun] = []
    while len(runs) < count:
        keyframes = round(float(np.exp(rng.uniform(*np.log(nodes)))))
        drawn = family.drawn(keyframes, rng)
        told = (torch.from_numpy(each) for each in (drawn.body_from_world, drawn.is_false, drawn.sigma**2))
        run = solved_run(drawn.graph, *told)
        if run is not None:
            runs.append(run)
    return runs
