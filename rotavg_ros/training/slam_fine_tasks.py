"""Training of the SLAM profile's FineNet: variances of edges, end to end through the sparse solve."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from rotavg_ros.datasets.simulation.stress.family import RobotFamily
from rotavg_ros.solver.learning.fine_tuning import Losses, SlamFineNet, SolvedRun, losses_of, losses_under, solved_run
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.drawing import drawn

# Weight of a nat per edge, for its variance's difference from the true one, relative to the mean error's logarithm. The
# error of a single drawing says little about the quality of weights; all its edges together say much.
NATS_WEIGHT = 0.3
# Share of the runs that are shown as they are after one pass of FineNet, so that it learns to be applied twice.
_SECOND_SHARE = 0.2
_LACK = "they have too few closures, or are solved too badly; longer ones, more closures or smaller errors would help"


class SlamFineTask:
    """SlamFineNet on solved runs of a family, all with the same weight."""

    def __init__(self, config: TrainingConfig) -> None:
        family = config.robots or RobotFamily()
        runs = draw_runs(family, config.graphs, config.nodes, np.random.default_rng((config.seed, 3)))
        validation = draw_runs(
            family, config.validation_graphs, config.validation_nodes, np.random.default_rng((config.seed, 4))
        )
        self._begin(config, runs, validation)

    @classmethod
    def on(cls, config: TrainingConfig, runs: list[SolvedRun], validation: list[SolvedRun]) -> SlamFineTask:
        """A task on given runs."""
        task = cls.__new__(cls)
        task._begin(config, runs, validation)
        return task

    def _begin(self, config: TrainingConfig, runs: list[SolvedRun], validation: list[SolvedRun]) -> None:
        self.config, self.runs, self.validation = config, runs, validation
        torch.manual_seed(config.seed)
        self.network = SlamFineNet()

    def num_batches(self) -> int:
        return -(-len(self.runs) // self.config.batch_graphs)

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        order = rng.permutation(len(self.runs))
        share = _SECOND_SHARE if self.config.passes > 1 else 0.0
        for start in range(0, len(order), self.config.batch_graphs):
            runs = [self.runs[index] for index in order[start : start + self.config.batch_graphs]]
            samples = [run.again(self.network) if rng.random() < share else run.first for run in runs]
            terms = Losses(*(values.mean() for values in losses_of(self.network, samples, rng)))
            loss = terms.log_error + terms.log_expected + NATS_WEIGHT * terms.nats
            yield {"loss": loss, **terms._asdict()}

    def validate(self) -> dict[str, float]:
        """Means, after one pass, of the logarithm of the errors relative to no FineNet, and of the nats."""
        samples = [run.first for run in self.validation]
        nothing = [torch.zeros_like(sample.used) for sample in samples]
        # The same errors are drawn every time.
        before = losses_under(nothing, samples, np.random.default_rng(self.config.seed))
        after = losses_of(self.network, samples, np.random.default_rng(self.config.seed))
        figures = {name: float((after._asdict()[name] - value).mean()) for name, value in before._asdict().items()}
        return {"objective": figures["log_error"] + figures["log_expected"] + NATS_WEIGHT * figures["nats"], **figures}


def draw_runs(family: RobotFamily, count: int, nodes: tuple[int, int], rng: np.random.Generator) -> list[SolvedRun]:
    """``count`` runs that were solved well enough to learn from.

    Raises:
        DrawingError: next to none is.
    """

    def draw() -> SolvedRun | None:
        run = family.drawn(round(float(np.exp(rng.uniform(*np.log(nodes))))), rng)
        told = (torch.from_numpy(each) for each in (run.body_from_world, run.is_false, run.sigma**2))
        return solved_run(run.graph, *told)

    return drawn(count, draw, _LACK)
