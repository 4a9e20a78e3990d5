"""The training loop: epochs, validation, best weights kept, checkpoints and exact resume."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from rotavg_ros.results import commit, make_folder
from rotavg_ros.solver.neurora.network_store import metadata
from rotavg_ros.training.checkpoint import load_checkpoint, save_checkpoint, save_tensors, save_text
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.run import Run, TrainingError, writing
from rotavg_ros.version import __version__

_MAX_GRADIENT_NORM = 1.0


class TrainingTask(Protocol):
    """A network and its training data. Losses and metrics are means; a smaller ``objective`` is better.

    ``batches`` draws only from the given generator, so that a resumed run sees the same as an uninterrupted one.
    """

    @property
    def network(self) -> nn.Module: ...

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        """One epoch: the loss terms of every batch, with the graph of ``loss`` attached."""
        ...

    def num_batches(self) -> int: ...

    def validate(self) -> dict[str, float]:
        """Figures on the validation graphs; ``objective`` decides which weights are kept."""
        ...


@dataclass(frozen=True)
class _State:
    epoch: int = 0
    best: float = math.inf
    seconds: float = 0.0


class Trainer:
    """Runs a task in a folder, which then has the files of a :class:`Run`.

    Args:
        task: network and data.
        config: the run's configuration.
        folder: created if missing; a checkpoint there is resumed; one of another run is refused, and so are weights.
        name, inputs, command: as in :class:`Run`.
    """

    def __init__(
        self,
        task: TrainingTask,
        config: TrainingConfig,
        folder: Path,
        name: str,
        inputs: Mapping[str, str] | None = None,
        command: str = "",
    ) -> None:
        self.task, self.config = task, config
        self._run = Run(config, folder, name, dict(inputs or {}), command)
        make_folder(folder)
        self._run.check()
        self.optimizer = torch.optim.Adam(
            task.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        # Mean weights by parameter, if there is to be a mean.
        parameters = dict(task.network.named_parameters()) if config.averaging > 0 else {}
        self._average = {key: value.detach().clone() for key, value in parameters.items()}
        self._state = _State()
        if self._run.checkpoint_path.exists():
            state = load_checkpoint(
                self._run.checkpoint_path, task.network, self.optimizer, self._average, self._run.identity()
            )
            self._state = _State(**state)
        with writing(self._run.folder):
            self._drop_log_after(self._state.epoch)

    @property
    def weights_path(self) -> Path:
        """Of the best validation."""
        return self._run.weights_path

    def card(self) -> dict[str, Any]:
        """The card of these weights."""
        return self._run.card()

    @property
    def epochs_done(self) -> int:
        return self._state.epoch

    @property
    def seconds(self) -> float:
        """Duration of its epochs, including those before an interruption."""
        return self._state.seconds

    def run(self, max_epochs: int | None = None) -> dict[str, float]:
        """Train to the end (or ``max_epochs`` more epochs); returns the last validation's figures.

        Raises:
            TrainingError: the loss is not finite, or a file cannot be written.
        """
        last = self.config.epochs if max_epochs is None else min(self.config.epochs, self._state.epoch + max_epochs)
        figures: dict[str, float] = {}
        first = self._state.epoch
        # A bar only on a terminal; elsewhere the log shows the progress.
        bar = tqdm(range(first, last), self._run.name, total=last, initial=first, unit="epoch", disable=None)
        for epoch in bar:
            start = time.perf_counter()
            losses = self._train(epoch)
            with torch.no_grad(), self._averaged(), writing(self._run.folder):
                figures = self.task.validate()
                if not math.isfinite(figures["objective"]):
                    raise TrainingError(_no_number("validation's objective", epoch))
                seconds = self._state.seconds + time.perf_counter() - start
                best = min(self._state.best, figures["objective"])
                is_better = best < self._state.best
                self._state = _State(epoch + 1, best, seconds)
                # The checkpoint comes last: a resumed run repeats everything that was interrupted before it.
                if is_better:
                    self._save_weights(figures)
            with writing(self._run.folder):
                self._log(epoch, losses, figures)
                save_checkpoint(
                    self._run.checkpoint_path,
                    self.task.network,
                    self.optimizer,
                    self._average,
                    self._run.identity(),
                    asdict(self._state),
                )
            bar.set_postfix_str(" ".join(f"{key} {value:.4g}" for key, value in {**losses, **figures}.items()))
        return figures

    def _train(self, epoch: int) -> dict[str, float]:
        """One epoch; returns the mean of every loss term."""
        network = self.task.network
        network.train()
        for group in self.optimizer.param_groups:
            group["lr"] = self._learning_rate(epoch)
        # Each epoch has its own random numbers, so that a resumed run draws the same as an uninterrupted one.
        rng = np.random.default_rng((self.config.seed, epoch))
        totals: dict[str, float] = {}
        for terms in self.task.batches(rng):
            if not bool(torch.isfinite(terms["loss"])):
                raise TrainingError(_no_number("loss", epoch))
            self.optimizer.zero_grad()
            terms["loss"].backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(network.parameters(), _MAX_GRADIENT_NORM)
            self.optimizer.step()
            self._follow()
            for key, value in terms.items():
                totals[key] = totals.get(key, 0.0) + float(value.detach()) / self.task.num_batches()
        network.eval()
        return totals

    def _learning_rate(self, epoch: int) -> float:
        warmup = self.config.warmup_epochs
        rising = min(1.0, (epoch + 1) / (warmup + 1))
        return self.config.learning_rate * rising * 0.5 * (1 + math.cos(math.pi * epoch / self.config.epochs))

    @torch.no_grad()
    def _follow(self) -> None:
        """Let the mean weights follow the network's."""
        parameters = dict(self.task.network.named_parameters())
        for key, mean in self._average.items():
            mean.lerp_(parameters[key], 1 - self.config.averaging)

    @contextmanager
    def _averaged(self) -> Iterator[None]:
        """For a block in which the network has the mean weights, if they are kept."""
        own = {key: value.detach().clone() for key, value in self.task.network.named_parameters()}
        self.task.network.load_state_dict({**self.task.network.state_dict(), **self._average})
        yield
        self.task.network.load_state_dict({**self.task.network.state_dict(), **own})

    def _save_weights(self, figures: dict[str, float]) -> None:
        card = {
            **self._run.origin(),
            "epoch": self._state.epoch,
            "hours": round(self._state.seconds / 3600, 3),
            "hardware": _hardware(self.task.network),
            "version": __version__,
            "commit": commit(),
            "torch": torch.__version__,
            "validation": {key: round(value, 5) for key, value in figures.items()},
        }
        save_tensors(self.weights_path, self.task.network.state_dict(), metadata(self._run.name))
        save_text(self._run.card_path, json.dumps(card, indent=2) + "\n")

    def _log(self, epoch: int, losses: dict[str, float], figures: dict[str, float]) -> None:
        row = {"epoch": epoch, **losses, **{f"validation_{key}": value for key, value in figures.items()}}
        with self._run.log_path.open("a") as log:
            log.write(json.dumps(row) + "\n")

    def _drop_log_after(self, epoch: int) -> None:
        """Remove the log lines of epochs that will be repeated."""
        if self._run.log_path.exists():
            lines = self._run.log_path.read_text(errors="replace").splitlines(keepends=True)
            save_text(self._run.log_path, "".join(lines[:epoch]))


def fingerprint(network: nn.Module) -> str:
    """Hash of a network's parameters, to tell whether it is the same one."""
    digest = hashlib.sha256()
    for key, value in sorted(network.state_dict().items()):
        digest.update(key.encode() + value.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _no_number(what: str, epoch: int) -> str:
    return f"the {what} is no number any more in epoch {epoch}; lower learning_rate"


def _hardware(network: nn.Module) -> str:
    device = next(network.parameters()).device
    return torch.cuda.get_device_name(device) if device.type == "cuda" else f"CPU, {torch.get_num_threads()} threads"
