"""The training loop: epochs, validation, best weights kept, checkpoints and exact resume."""

from __future__ import annotations

import hashlib
import json
import math
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
import torch
from torch import Tensor, nn
from tqdm import tqdm

from rotavg_ros.errors import UserError
from rotavg_ros.results import commit, make_folder
from rotavg_ros.solver.neurora.network_store import metadata
from rotavg_ros.training.checkpoint import load_checkpoint, save_checkpoint, save_tensors, save_text
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.version import __version__

_MAX_GRADIENT_NORM = 1.0


class TrainingError(UserError):
    """A training run that cannot start or continue; the message says why."""


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
    """Runs a task in a folder.

    What it keeps there for a network called NAME:

    - ``NAME.safetensors``, the weights of the best validation, and ``NAME.json``, their model card;
    - ``NAME.checkpoint.safetensors``, from which a run continues exactly as if it had never stopped;
    - ``NAME.log.jsonl``, a line per epoch.

    Args:
        task: network and data.
        config: the run's configuration.
        folder: created if missing; a checkpoint there is resumed; one of another run is refused, and so are weights.
        name: of the network, as in :data:`rotavg_ros.solver.networks.NETWORKS`.
        inputs: other inputs that decide the outcome (fingerprints of other networks), for card and checkpoint.
        command: the command that repeats the run, for the card.
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
        self.task, self.config, self.name, self.command = task, config, name, command
        self.inputs = dict(inputs or {})
        make_folder(folder)
        self.weights_path = folder / f"{name}.safetensors"
        self.card_path = folder / f"{name}.json"
        self._checkpoint_path = folder / f"{name}.checkpoint.safetensors"
        self._log_path = folder / f"{name}.log.jsonl"
        self.optimizer = torch.optim.Adam(
            task.network.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay
        )
        # Mean weights by parameter, if there is to be a mean.
        parameters = dict(task.network.named_parameters()) if config.averaging > 0 else {}
        self._average = {key: value.detach().clone() for key, value in parameters.items()}
        self._state = _State()
        if self._checkpoint_path.exists():
            state = load_checkpoint(
                self._checkpoint_path, task.network, self.optimizer, self._average, self._identity()
            )
            self._state = _State(**state)
            self._check_best()
        else:
            self._check_free()
        with self._writing():
            self._drop_log_after(self._state.epoch)

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
        bar = tqdm(range(first, last), self.name, total=last, initial=first, unit="epoch", disable=None)
        for epoch in bar:
            start = time.perf_counter()
            losses = self._train(epoch)
            with torch.no_grad(), self._averaged(), self._writing():
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
            with self._writing():
                self._log(epoch, losses, figures)
                save_checkpoint(
                    self._checkpoint_path,
                    self.task.network,
                    self.optimizer,
                    self._average,
                    self._identity(),
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

    @contextmanager
    def _writing(self) -> Iterator[None]:
        """For a block that writes files of the run; an older one that cannot be replaced stays as it is."""
        try:
            yield
        except OSError as error:
            path = error.filename2 or error.filename or self.weights_path.parent
            raise TrainingError(f"{path}: cannot be written ({error.strerror}); mend that and run it again") from None

    def _identity(self) -> dict[str, Any]:
        return {**metadata(self.name), "config": self.config.to_dict(), **self.inputs}

    def _origin(self) -> dict[str, Any]:
        """What its card says of how to repeat the run."""
        return {"network": self.name, "command": self.command, "config": self.config.to_dict(), **self.inputs}

    def _save_weights(self, figures: dict[str, float]) -> None:
        card = {
            **self._origin(),
            "epoch": self._state.epoch,
            "hours": round(self._state.seconds / 3600, 3),
            "hardware": _hardware(self.task.network),
            "version": __version__,
            "commit": commit(),
            "torch": torch.__version__,
            "validation": {key: round(value, 5) for key, value in figures.items()},
        }
        save_tensors(self.weights_path, self.task.network.state_dict(), metadata(self.name))
        save_text(self.card_path, json.dumps(card, indent=2) + "\n")

    def _log(self, epoch: int, losses: dict[str, float], figures: dict[str, float]) -> None:
        row = {"epoch": epoch, **losses, **{f"validation_{key}": value for key, value in figures.items()}}
        with self._log_path.open("a") as log:
            log.write(json.dumps(row) + "\n")

    def card(self) -> dict[str, Any]:
        """The card of the weights in its folder; empty if it is missing or damaged."""
        with suppress(OSError, ValueError):
            card = json.loads(self.card_path.read_text())
            return card if isinstance(card, dict) else {}
        return {}

    def _check_best(self) -> None:
        """Refuse a checkpoint without the best weights before it, which it does not hold itself."""
        what = f"put it back, or remove {self._checkpoint_path.name}, which goes on from there, to start anew"
        for path in (self.weights_path, self.card_path):
            if not path.exists():
                raise TrainingError(f"{path}: is missing; {what}")
        if not {"epoch", "validation"} <= self.card().keys():
            raise TrainingError(f"{self.card_path}: is damaged; {what}")

    def _check_free(self) -> None:
        """Refuse to begin beside weights of another run, which the first epoch would overwrite.

        Weights of this run without a checkpoint are those of a first epoch that was killed while it was saved.
        """
        card = self.card()
        if self.weights_path.exists() and any(card.get(key) != value for key, value in self._origin().items()):
            what = "move it away or choose another folder"
            raise TrainingError(f"{self.weights_path}: is of another run and would be overwritten; {what}")

    def _drop_log_after(self, epoch: int) -> None:
        """Remove the log lines of epochs that will be repeated."""
        if self._log_path.exists():
            lines = self._log_path.read_text(errors="replace").splitlines(keepends=True)
            save_text(self._log_path, "".join(lines[:epoch]))


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
