"""Training within a given time goes on where it was interrupted."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from torch import Tensor

from rotavg_ros.training import timed
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.paper_tasks import PaperCleanTask
from rotavg_ros.training.timed import train_in_time

NAME, EPOCHS = "paper-clean-net", 4
CONFIG = TrainingConfig(
    family="paper", recipe="paper", nodes=(12, 12), graphs=2, validation_nodes=(12, 12), validation_graphs=1
)


def make_task() -> PaperCleanTask:
    return PaperCleanTask(CONFIG, torch.device("cpu"))


class InterruptedTask(PaperCleanTask):
    """Stops after two epochs."""

    done = 0

    def batches(self, rng: np.random.Generator) -> Iterator[dict[str, Tensor]]:
        if self.done == 2:
            raise KeyboardInterrupt
        self.done += 1
        yield from super().batches(rng)


def make_interrupted() -> PaperCleanTask:
    return InterruptedTask(CONFIG, torch.device("cpu"))


def test_an_interrupted_run_goes_on_and_a_finished_one_is_left_alone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(timed, "epochs_that_fit", lambda *_: EPOCHS)
    unbroken = train_in_time(tmp_path / "unbroken", NAME, make_task, CONFIG, 1.0)
    assert unbroken.epochs == EPOCHS

    # By now the machine is faster; a run that has begun keeps its length, on which its learning rate depends.
    with pytest.raises(KeyboardInterrupt):
        train_in_time(tmp_path / "broken", NAME, make_interrupted, CONFIG, 1.0)
    monkeypatch.setattr(timed, "epochs_that_fit", lambda *_: 3 * EPOCHS)
    resumed = train_in_time(tmp_path / "broken", NAME, make_task, CONFIG, 1.0)
    assert resumed.epochs == EPOCHS
    assert resumed.seconds is not None and resumed.seconds > 0
    weights = [load_file(tmp_path / folder / f"{NAME}.safetensors") for folder in ("unbroken", "broken")]
    assert all(torch.equal(value, weights[1][key]) for key, value in weights[0].items())
    assert len((tmp_path / "broken" / f"{NAME}.log.jsonl").read_text().splitlines()) == EPOCHS

    def never() -> PaperCleanTask:
        raise AssertionError

    assert train_in_time(tmp_path / "broken", NAME, never, CONFIG, 1.0) == resumed


def test_so_many_epochs_as_fit() -> None:
    assert timed.epochs_that_fit(NAME, make_task, CONFIG, 0.0) == 1
    assert timed.epochs_that_fit(NAME, make_task, CONFIG, 3600.0) > 100
