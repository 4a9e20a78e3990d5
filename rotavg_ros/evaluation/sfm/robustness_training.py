"""The paper's NeuRoRA, trained for its robustness check on one kind of graph, within a given time."""

from __future__ import annotations

import hashlib
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.evaluation.sfm.published import Configuration
from rotavg_ros.evaluation.sfm.robustness import recipe_of
from rotavg_ros.evaluation.sfm.small_training import CLEAN_NET_SHARE
from rotavg_ros.solver.networks import PaperCleanNet, PaperFineNet, read_network
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.paper_tasks import PaperCleanTask, PaperFineTask
from rotavg_ros.training.sfm_tasks import GivenGraphs
from rotavg_ros.training.timed import TimedRun, train_in_time

# The paper's edge dropout, not its learning rate of 5e-5: ours begins at twenty times that and falls to zero, without
# weight decay, as it did for the package's own networks of this kind.
TRAINING = TrainingConfig(
    family="paper", recipe="paper", batch_graphs=1, learning_rate=1e-3, weight_decay=0.0, edge_dropout=0.25
)
# Graphs are drawn once and kept in memory, of which edges take about 250 bytes each.
_MOST_EDGES, _MOST_GRAPHS, _VALIDATION_GRAPHS = 3_000_000, 400, 6
_STREAM = 0x0B58


@dataclass(frozen=True)
class Trained:
    """The two networks of a configuration.

    Attributes:
        folder: their weights and logs.
        graphs: number of training graphs.
        runs: by network, CleanNet first.
    """

    folder: Path
    graphs: int
    runs: dict[str, TimedRun]

    @property
    def minutes(self) -> float:
        """Training time of both together."""
        return sum(run.seconds or 0.0 for run in self.runs.values()) / 60

    def log(self, network: str) -> Path:
        """Path of a network's log, with a line per epoch."""
        return self.folder / f"{network}.log.jsonl"


def train(folder: Path, configuration: Configuration, seconds: float, seed: int = 0) -> Trained:
    """Train CleanNet, then FineNet behind it, into a folder below ``folder``; the best validation is kept.

    Finished trainings there are not repeated, and interrupted ones are resumed. Another recipe, time, seed or way of
    training has another folder.

    Args:
        seconds: approximate time for both; at least one epoch each is run.
    """
    recipe, config = recipe_of(configuration), replace(TRAINING, seed=seed)
    digest = hashlib.sha256(repr((recipe, config, seconds, num_graphs(recipe))).encode()).hexdigest()[:8]
    folder = folder / ("-".join(re.findall(r"[a-z0-9.]+", str(configuration))) + f"-{digest}")
    make = _Tasks(recipe, config, folder)
    runs = {
        PaperCleanNet.NAME: train_in_time(folder, PaperCleanNet.NAME, make.clean, config, seconds * CLEAN_NET_SHARE),
        PaperFineNet.NAME: train_in_time(folder, PaperFineNet.NAME, make.fine, config, seconds * (1 - CLEAN_NET_SHARE)),
    }
    return Trained(folder, num_graphs(recipe), runs)


def num_graphs(recipe: PaperRecipe) -> int:
    """Number of training graphs of a recipe: as many as fit in memory."""
    edges = math.comb(recipe.cameras[1], 2) * recipe.pair_share[1]
    return max(1, min(_MOST_GRAPHS, int(_MOST_EDGES / edges)))


def training_graphs(recipe: PaperRecipe, seed: int) -> GivenGraphs:
    """Training graphs, and a few more for validation."""
    rng = np.random.default_rng((seed, _STREAM))
    drawn = [recipe.sample(rng) for _ in range(num_graphs(recipe) + _VALIDATION_GRAPHS)]
    return GivenGraphs(drawn[_VALIDATION_GRAPHS:], drawn[:_VALIDATION_GRAPHS])


@dataclass(frozen=True)
class _Tasks:
    """The training tasks, created on demand."""

    recipe: PaperRecipe
    config: TrainingConfig
    folder: Path

    def clean(self) -> PaperCleanTask:
        return PaperCleanTask(self.config, torch.device("cpu"), training_graphs(self.recipe, self.config.seed))

    def fine(self) -> PaperFineTask:
        clean_net = read_network(PaperCleanNet, self.folder / f"{PaperCleanNet.NAME}.safetensors")
        graphs = training_graphs(self.recipe, self.config.seed)
        return PaperFineTask(self.config, torch.device("cpu"), clean_net, graphs)
