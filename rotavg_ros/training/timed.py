"""Training within a given time: as many epochs as fit, decided once, so that an interrupted run goes on as planned."""

from __future__ import annotations

import json
import tempfile
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from pathlib import Path

from rotavg_ros.results import make_folder
from rotavg_ros.training.checkpoint import save_text
from rotavg_ros.training.config import TrainingConfig
from rotavg_ros.training.trainer import Trainer, TrainingTask


@dataclass(frozen=True)
class TimedRun:
    """A run of a length that was decided by time; ``NAME.run.json`` beside what :class:`Trainer` writes.

    Attributes:
        epochs: as many as were thought to fit.
        seconds: that they took; None: they are not over yet.
    """

    epochs: int
    seconds: float | None = None


def train_in_time(
    folder: Path, name: str, make_task: Callable[[], TrainingTask], config: TrainingConfig, seconds: float
) -> TimedRun:
    """Train a network for about so many seconds, at least one epoch; what is finished in ``folder`` is left alone.

    Args:
        name: of the network.
        make_task: is called twice at first: the learning rate's schedule needs the number of epochs beforehand, so
            one is timed on a task of its own.
        config: but for its ``epochs``.
    """
    make_folder(folder)
    path = folder / f"{name}.run.json"
    run = _read(path)
    if run is None:
        run = TimedRun(epochs_that_fit(name, make_task, config, seconds))
        save_text(path, json.dumps(asdict(run)) + "\n")
    if run.seconds is None:
        trainer = Trainer(make_task(), replace(config, epochs=run.epochs), folder, name)
        trainer.run()
        run = replace(run, seconds=trainer.seconds)
        save_text(path, json.dumps(asdict(run)) + "\n")
    return run


def epochs_that_fit(name: str, make_task: Callable[[], TrainingTask], config: TrainingConfig, seconds: float) -> int:
    """How many follow within ``seconds`` after one that is timed, what it takes to make the task included."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as trial:
        trainer = Trainer(make_task(), replace(config, epochs=1), Path(trial), name)
        trainer.run()
    left = seconds - (time.perf_counter() - start)
    return max(1, int(left / trainer.seconds))


def _read(path: Path) -> TimedRun | None:
    """None: none yet, or no such file (a checkpoint beside it then says whether its run can go on)."""
    with suppress(OSError, ValueError, TypeError):
        return TimedRun(**json.loads(path.read_text()))
    return None
