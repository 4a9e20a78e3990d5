"""What ``rotavg train`` does: it trains to the end of the configuration's epochs."""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import torch

from rotavg_ros.cli import train_on_robot
from rotavg_ros.cli.main import print_warning
from rotavg_ros.cli.progress import working
from rotavg_ros.errors import UserError, asking_about
from rotavg_ros.results import make_folder
from rotavg_ros.solver.networks import NETWORKS, WEIGHTS_FOLDER, CleanNet, PaperCleanNet, read_network
from rotavg_ros.training.config import TrainingConfig, TrainingConfigError
from rotavg_ros.training.paper_tasks import PaperCleanTask, PaperFineTask
from rotavg_ros.training.run import Run
from rotavg_ros.training.sfm_tasks import SfmCleanTask, SfmFineTask
from rotavg_ros.training.slam_fine_tasks import SlamFineTask
from rotavg_ros.training.slam_tasks import SlamCleanTask
from rotavg_ros.training.trainer import Trainer, TrainingTask, fingerprint

# Largest numbers of FineNet's passes in a row, where the task has one.
_MOST_PASSES = {"slam": 2, "paper": 1}
# Share of the weights before the first step in their mean at the end. With a quarter (660 steps, averaging 0.998), the
# error of a FineNet of SfM is twice as large as without averaging.
_MOST_OF_FIRST = 0.02
_CONFIGS = Path(__file__).parent.parent / "training" / "configs"


class TrainCommandError(UserError):
    """Options of ``rotavg train`` that do not fit together."""


def run(arguments: argparse.Namespace) -> int:
    """Train to the end of the configuration's epochs."""
    if arguments.threads is not None:
        torch.set_num_threads(arguments.threads)
    if (arguments.network == "slam") != (arguments.runs is not None):
        raise TrainCommandError("slam fine-tunes on your runs and needs --from GRAPH…; other networks take none")
    if arguments.network == "slam":
        return train_on_robot.run(arguments)
    if arguments.truth is not None:
        raise TrainCommandError("--truth is for slam; other networks learn on simulated graphs")
    name = _config_name(arguments)
    config = load_config(name)
    trainer = make_trainer(
        arguments.network,
        config,
        Inputs(name, arguments.clean_net, arguments.start),
        arguments.output,
        arguments.device,
    )
    if trainer.epochs_done:
        print(f"going on after epoch {trainer.epochs_done} of {config.epochs}", flush=True)
    _warn_of_averaging(config, name)
    trainer.run()
    card = trainer.card()
    figures = ", ".join(f"{name} {value:.4g}" for name, value in card["validation"].items())
    print(f"{trainer.weights_path}: epoch {card['epoch']} of {config.epochs}, {figures}")
    return 0


def _warn_of_averaging(config: TrainingConfig, name: str) -> None:
    """Warn where the mean over the steps still has a good part of the weights before the first one at the end."""
    steps = config.epochs * -(-config.graphs // config.batch_graphs)
    share = config.averaging**steps
    if share > _MOST_OF_FIRST:
        print_warning(
            f"{name}: with averaging {config.averaging:g}, {100 * share:.0f} % of what is kept after all {steps} steps "
            "are the weights before the first; lower it, or train for more epochs or on more graphs"
        )


def _config_name(arguments: argparse.Namespace) -> str:
    """The configuration that was given, or the one with the network's name."""
    network: str = arguments.network
    if arguments.config is None and network not in _shipped():
        several = ", ".join(name for name in _shipped() if network in name and not name.startswith("slam"))
        raise TrainCommandError(f"{network} has no configuration of its name; give a YAML file or one of {several}")
    return arguments.config or network


def _shipped() -> dict[str, Path]:
    """The package's configurations by name."""
    return {path.stem: path for path in sorted(_CONFIGS.glob("*.yaml"))}


def load_config(name: str) -> TrainingConfig:
    """A configuration by path or, without a file of that name, by the name of a shipped one.

    Raises:
        TrainingConfigError: neither exists, or the file is not a configuration.
    """
    shipped = _shipped()
    path = Path(name)
    with asking_about(path, TrainingConfigError):
        # An --output may have the name of a configuration.
        is_given = path.exists() and not (name in shipped and path.is_dir())
    if not is_given:
        if name not in shipped:
            raise TrainingConfigError(f"{name}: no such file; the package's own are {', '.join(shipped)}")
        path = shipped[name]
    return TrainingConfig.load(path)


@dataclass(frozen=True)
class Inputs:
    """What a training begins with.

    Attributes:
        config: how the user named the configuration, for the card.
        clean_net: weights of the CleanNet that precedes a FineNet.
        start: initial weights.
    """

    config: str
    clean_net: Path | None = None
    start: Path | None = None


def make_trainer(network: str, config: TrainingConfig, given: Inputs, output: Path, device: str) -> Trainer:
    """Task and trainer for a network of the configuration's family.

    Args:
        network: "clean-net" or "fine-net"; "slam-clean-net" and "slam-fine-net" are those of that family alone.
        device: "auto", "cpu" or "cuda".

    Raises:
        UserError: options that do not fit, weights or a checkpoint that cannot be used.
    """
    if network.startswith("slam-") and config.family != "slam":
        raise TrainCommandError(f"{given.config}: is of the family {config.family}, {network} of the family slam")
    asked, network = network, network.removeprefix("slam-")
    if network == "clean-net" and given.clean_net is not None:
        raise TrainCommandError("--clean-net is for fine-net; to go on with a CleanNet, give the same --output")
    if config.goes_on_from and given.start is None:
        raise TrainCommandError(
            f"{given.config}: goes on from the weights that `rotavg train {network} {config.goes_on_from}` makes; "
            "name them with --start"
        )
    if config.family == "slam" and network == "fine-net" and config.recipe != "robots":
        raise TrainCommandError(f"{given.config}: FineNet of robots' graphs needs `recipe: robots`")
    if config.family == "slam" and given.clean_net is not None:
        raise TrainCommandError("--clean-net is for SfM's fine-net; robots' graphs are solved with the package's")
    if config.family == "slam" and device == "cuda":
        raise TrainCommandError("the SLAM profile's networks train on the CPU, where its graphs live")
    most = _MOST_PASSES.get(config.family, config.passes)
    if network == "fine-net" and config.passes > most:
        what = f"FineNet of the family {config.family} learns from {most} in a row at most"
        raise TrainCommandError(f"{given.config}: passes is {config.passes}; {what}")
    if config.family == "slam" and network == "fine-net":
        config = replace(config, edge_dropout=0.0)  # its runs are solved as they are; the card is to say so
    name = f"{config.family}-{network}"
    # Errors in any of the files, and what is in the folder, are noticed before the minutes that drawing graphs takes.
    weights = None if given.start is None else read_network(NETWORKS[name], given.start)
    inputs: dict[str, str] = {}
    before: CleanNet | None = None
    if network == "fine-net" and config.family != "slam":
        before = _clean_net(PaperCleanNet if config.family == "paper" else CleanNet, output, given.clean_net)
        inputs["clean_net_fingerprint"] = fingerprint(before)
    make_folder(output)
    command = f"rotavg train {asked} {Path(given.config).stem if Path(given.config).exists() else given.config}"
    if given.clean_net is not None:
        command += " --clean-net WEIGHTS"
    if weights is not None:
        inputs["start_fingerprint"] = fingerprint(weights)
        command += " --start WEIGHTS"
    Run(config, output, name, inputs, command).check()
    task = _task(config, network, before, device)
    if weights is not None:
        task.network.load_state_dict(weights.state_dict())
    return Trainer(task, config, output, name, inputs, command)


def _task(config: TrainingConfig, network: str, before: CleanNet | None, device: str) -> TrainingTask:
    """The task, with its graphs; ``before`` is the CleanNet of an SfM FineNet."""
    if config.family == "slam":
        with working("simulating pose graphs"):
            return SlamCleanTask(config) if network == "clean-net" else SlamFineTask(config)
    on = _torch_device(device)
    with working("drawing view-graphs"):
        if before is None:
            return PaperCleanTask(config, on) if config.family == "paper" else SfmCleanTask(config, on)
        if isinstance(before, PaperCleanNet):
            return PaperFineTask(config, on, before)
        return SfmFineTask(config, on, before)


def _clean_net(kind: type[CleanNet], output: Path, given: Path | None) -> CleanNet:
    trained = output / f"{kind.NAME}.safetensors"
    path = given or (trained if trained.exists() else WEIGHTS_FOLDER / trained.name)
    return read_network(kind, path)


def _torch_device(name: str) -> torch.device:
    if name == "cuda" and not torch.cuda.is_available():
        raise TrainCommandError("device 'cuda': torch finds no usable GPU; use --device cpu or auto")
    use_gpu = name == "cuda" or (name == "auto" and torch.cuda.is_available())
    return torch.device("cuda" if use_gpu else "cpu")
