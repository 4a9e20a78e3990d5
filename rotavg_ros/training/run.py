"""A training run on disk: what identifies it, its files, and whether it can begin or go on."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from rotavg_ros.errors import UserError
from rotavg_ros.solver.neurora.network_store import metadata
from rotavg_ros.training.checkpoint import check_checkpoint
from rotavg_ros.training.config import TrainingConfig


class TrainingError(UserError):
    """A training run that cannot start or continue; the message says why."""


@contextmanager
def writing(folder: Path) -> Iterator[None]:
    """For a block that writes files into a folder; an older file that cannot be replaced stays as it is.

    Raises:
        TrainingError: one cannot be written.
    """
    try:
        yield
    except OSError as error:
        path = error.filename2 or error.filename or folder
        raise TrainingError(f"{path}: cannot be written ({error.strerror}); mend that and run it again") from None


@dataclass(frozen=True)
class Run:
    """A training run: what decides its outcome, and its files in a folder.

    For a network called NAME these are:

    - ``NAME.safetensors``, the weights of the best validation, and ``NAME.json``, their model card;
    - ``NAME.checkpoint.safetensors``, from which a run continues exactly as if it had never stopped;
    - ``NAME.log.jsonl``, a line per epoch.

    Attributes:
        config: its configuration.
        folder: of the files.
        name: of the network, as in :data:`rotavg_ros.solver.networks.NETWORKS`.
        inputs: other inputs that decide the outcome (fingerprints of other networks), for card and checkpoint.
        command: the command that repeats the run, for the card.
    """

    config: TrainingConfig
    folder: Path
    name: str
    inputs: Mapping[str, str]
    command: str

    @property
    def weights_path(self) -> Path:
        return self.folder / f"{self.name}.safetensors"

    @property
    def card_path(self) -> Path:
        return self.folder / f"{self.name}.json"

    @property
    def checkpoint_path(self) -> Path:
        return self.folder / f"{self.name}.checkpoint.safetensors"

    @property
    def log_path(self) -> Path:
        return self.folder / f"{self.name}.log.jsonl"

    def identity(self) -> dict[str, Any]:
        """What must be the same for a checkpoint to be resumed."""
        return {**metadata(self.name), "config": self.config.to_dict(), **self.inputs}

    def origin(self) -> dict[str, Any]:
        """What the card says of how to repeat the run."""
        return {"network": self.name, "command": self.command, "config": self.config.to_dict(), **self.inputs}

    def card(self) -> dict[str, Any]:
        """The card of the weights in the folder; empty if it is missing or damaged."""
        with suppress(OSError, ValueError):
            card = json.loads(self.card_path.read_text())
            return card if isinstance(card, dict) else {}
        return {}

    def check(self) -> None:
        """Check, before graphs are drawn for minutes, that the run can begin or go on in its folder.

        Raises:
            UserError: files of another run are in its place, or some of its own are missing.
        """
        if self.checkpoint_path.exists():
            check_checkpoint(self.checkpoint_path, self.identity())
            self._check_best()
        else:
            self._check_free()

    def _check_best(self) -> None:
        """Refuse a checkpoint without the best weights before it, which it does not hold itself."""
        what = f"put it back, or remove {self.checkpoint_path.name}, which goes on from there, to start anew"
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
        if self.weights_path.exists() and any(card.get(key) != value for key, value in self.origin().items()):
            what = "move it away or choose another folder"
            raise TrainingError(f"{self.weights_path}: is of another run and would be overwritten; {what}")
