"""The training loop: epochs, validation, best weights kept, checkpoints and exact resume."""

from __future__ import annotations

import json
import os
import subprocess
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import load_file, save_file
from torch import Tensor, nn
from tqdm import tqdm

from rotavg_ros.errors import UserError
from rotavg_ros.solver.network_store import metadata
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.version import __version__

CHECKPOINT_NAME = "checkpoint.safetensors"
WEIGHTS_NAME = "weights.safetensors"
CARD_NAME = "card.json"


class TrainingError(UserError):
    """A training run that cannot start or go on; the message says why."""


class TrainingTask(Protocol):
    """What is trained on what. Losses and metrics are means; smaller ``objective`` is better."""

    network: nn.Module

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        """One epoch: the loss terms of every batch, with the graph of ``loss`` attached."""
        ...

    def num_batches(self) -> int: ...

    def validate(self) -> dict[str, float]:
        """Figures on the validation graphs; ``objective`` decides which weights are kept."""
        ...


@dataclass
class _State:
    epoch: int
    best: float
    seconds: float


class Trainer:
    """Runs a task in ``folder``, which holds the checkpoint, the best weights and their model card.

    Args:
        task: network and data.
        config: the run's configuration; a checkpoint of another one is refused.
        folder: created if missing; a checkpoint there is resumed.
        name: what is trained, for the card ("clean-net").
    """

    def __init__(self, task: TrainingTask, config: TrainingConfig, folder: Path, name: str) -> None:
        self.task, self.config, self.folder, self.name = task, config, folder, name
        self.optimizer = torch.optim.Adam(
            task.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        self._state = _State(0, float("inf"), 0.0)
        folder.mkdir(parents=True, exist_ok=True)
        if (folder / CHECKPOINT_NAME).exists():
            self._resume()

    def run(self, max_epochs: int | None = None) -> dict[str, float]:
        """Train to the end (or ``max_epochs`` more epochs); returns the last validation's figures."""
        network = self.task.network
        last = self.config.epochs if max_epochs is None else min(self.config.epochs, self._state.epoch + max_epochs)
        figures: dict[str, float] = {}
        bar = tqdm(range(self._state.epoch, last), initial=self._state.epoch, total=last, unit="epoch", delay=2)
        for epoch in bar:
            start = time.perf_counter()
            self._set_learning_rate(epoch)
            network.train()
            # Each epoch has its own random numbers, so that a resumed run draws what an unbroken one would.
            rng = np.random.default_rng((self.config.seed, epoch))
            totals: dict[str, float] = {}
            for terms in self.task.batches(rng):
                self.optimizer.zero_grad()
                terms["loss"].backward()
                nn.utils.clip_grad_norm_(network.parameters(), 1.0)
                self.optimizer.step()
                for key, value in terms.items():
                    totals[key] = totals.get(key, 0.0) + float(value.detach()) / self.task.num_batches()
            network.eval()
            with torch.no_grad():
                figures = self.task.validate()
            self._state = _State(
                epoch + 1, self._state.best, self._state.seconds + time.perf_counter() - start
            )
            if figures["objective"] < self._state.best:
                self._state.best = figures["objective"]
                self._save_best(figures)
            self._save_checkpoint()
            self._log(epoch, totals, figures)
            bar.set_postfix_str(" ".join(f"{key} {value:.4g}" for key, value in {**totals, **figures}.items()))
        return figures

    def _set_learning_rate(self, epoch: int) -> None:
        progress = epoch / self.config.epochs
        for group in self.optimizer.param_groups:
            group["lr"] = self.config.learning_rate * (0.5 * (1 + np.cos(np.pi * progress)))

    def _save_best(self, figures: dict[str, float]) -> None:
        _save_atomically(self.task.network.state_dict(), self.folder / WEIGHTS_NAME, metadata(self.name))
        card = {
            "network": self.name,
            "config": self.config.to_dict(),
            "epoch": self._state.epoch,
            "hours": round(self._state.seconds / 3600, 3),
            "hardware": _hardware(self.task.network),
            "version": __version__,
            "commit": _commit(),
            "torch": torch.__version__,
            "validation": {key: round(value, 5) for key, value in figures.items()},
        }
        _write_atomically(json.dumps(card, indent=2) + "\n", self.folder / CARD_NAME)

    def _save_checkpoint(self) -> None:
        tensors = {f"network.{key}": value for key, value in self.task.network.state_dict().items()}
        for number, state in self.optimizer.state_dict()["state"].items():
            tensors.update({f"optimizer.{number}.{key}": value for key, value in state.items()})
        about = {"config": json.dumps(self.config.to_dict()), "state": json.dumps(vars(self._state))}
        _save_atomically(tensors, self.folder / CHECKPOINT_NAME, about)

    def _resume(self) -> None:
        path = self.folder / CHECKPOINT_NAME
        try:
            with safe_open(path, framework="pt") as file:
                about = file.metadata()
            tensors = load_file(path)
            config, state = json.loads(about["config"]), json.loads(about["state"])
        except (SafetensorError, OSError, KeyError, TypeError, json.JSONDecodeError):
            raise TrainingError(f"{path}: not a checkpoint; remove the file to start anew") from None
        if config != self.config.to_dict():
            changed = [key for key, value in self.config.to_dict().items() if config.get(key) != value]
            raise TrainingError(f"{path}: from a run with another {', '.join(changed)}; choose another folder")
        network = {key[8:]: value for key, value in tensors.items() if key.startswith("network.")}
        self.task.network.load_state_dict(network)
        moments: dict[int, dict[str, Tensor]] = {}
        for key, value in tensors.items():
            if key.startswith("optimizer."):
                _, number, entry = key.split(".")
                moments.setdefault(int(number), {})[entry] = value
        saved = self.optimizer.state_dict()
        saved["state"] = moments
        self.optimizer.load_state_dict(saved)
        self._state = _State(**state)

    def _log(self, epoch: int, totals: dict[str, float], figures: dict[str, float]) -> None:
        row = {"epoch": epoch, **totals, **{f"validation_{key}": value for key, value in figures.items()}}
        with (self.folder / "log.jsonl").open("a") as log:
            log.write(json.dumps(row) + "\n")


def _save_atomically(tensors: dict[str, Tensor], path: Path, about: dict[str, str]) -> None:
    temporary = path.with_suffix(".partial")
    save_file({key: value.detach().cpu().contiguous() for key, value in tensors.items()}, temporary, about)
    os.replace(temporary, path)


def _write_atomically(text: str, path: Path) -> None:
    temporary = path.with_suffix(".partial")
    temporary.write_text(text)
    os.replace(temporary, path)


def _hardware(network: nn.Module) -> str:
    device = next(network.parameters()).device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"


def _commit() -> str:
    try:
        command = ["git", "rev-parse", "--short", "HEAD"]
        result = subprocess.run(command, cwd=Path(__file__).parent, capture_output=True, text=True, check=True)
    except (OSError, subprocess.CalledProcessError):
        return "unknown"
    return result.stdout.strip()
