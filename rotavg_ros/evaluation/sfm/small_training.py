"""Networks trained inside an evaluation, on given graphs and within a given time."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import torch

from rotavg_ros.solver.networks import NETWORKS, CleanNet, load_network, read_network
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.sfm_tasks import GivenGraphs, SfmCleanTask, SfmFineTask
from rotavg_ros.training.timed import train_in_time
from rotavg_ros.training.trainer import TrainingTask

# CleanNet has the harder problem.
CLEAN_NET_SHARE = 0.6
_CONFIG = TrainingConfig(batch_graphs=4, learning_rate=2e-3, weight_decay=0.0)


def train_networks(
    folder: Path, graphs: GivenGraphs, seconds: float, seed: int = 0, from_package: bool = False
) -> None:
    """Train a CleanNet and a FineNet into ``folder``, which then serves as ``weights`` of a solve.

    Args:
        seconds: approximate time for both; at least one epoch each is run.
        from_package: start from the package's networks instead of random ones.
    """
    config = replace(_CONFIG, seed=seed)
    cpu = torch.device("cpu")
    make_clean = _maker("sfm-clean-net", partial(SfmCleanTask, config, cpu, graphs), from_package)
    train_in_time(folder, "sfm-clean-net", make_clean, config, seconds * CLEAN_NET_SHARE)
    clean_net = read_network(CleanNet, folder / "sfm-clean-net.safetensors")
    make_fine = _maker("sfm-fine-net", partial(SfmFineTask, config, cpu, clean_net, graphs), from_package)
    train_in_time(folder, "sfm-fine-net", make_fine, config, seconds * (1 - CLEAN_NET_SHARE))


def _maker(name: str, make_task: Callable[[], TrainingTask], from_package: bool) -> Callable[[], TrainingTask]:
    """A function that makes a task whose network has the requested initial weights."""

    def make() -> TrainingTask:
        task = make_task()
        if from_package:
            task.network.load_state_dict(load_network(NETWORKS[name]).state_dict())
        return task

    return make
