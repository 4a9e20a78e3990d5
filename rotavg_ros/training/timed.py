"""Training within a given time: as many epochs as fit, decided once, so that a resumed run continues as planned."""

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
    """A run whose length was decided by time; saved as ``NAME.run.json`` beside the files of :class:`Trainer`.

    Attributes:
        epochs: number of epochs that were expected to fit.
        seconds: that they took; None: not finished yet.
    """

    epochs: int
    seconds: float | None = None


def train_in_time(
    folder: Path, name: str, make_task: Callable[[], TrainingTask], config: TrainingConfig, seconds: float
) -> TimedRun:
    """Train a network for about the given time, at least one epoch; a finished run in ``folder`` is left alone.

    Args:
        name: of the network.
        make_task: is called twice at first: the learning rate's schedule needs the number of epochs beforehand, so
            one is timed on a task of its own.
        config: everything except ``epochs``.
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
    """Number of epochs that fit into ``seconds`` after a timed one, including the time to make the task."""
    start = time.perf_counter()
    with tempfile.TemporaryDirectory() as trial:
        trainer = Trainer(make_task(), replace(config, epochs=1), Path(trial), name)
        trainer.run()
    left = seconds - (time.perf_counter() - start)
    return max(1, int(left / trainer.seconds))


def _read(path: Path) -> TimedRun | None:
    """The saved run; None if there is no valid file (a checkpoint beside it then decides whether it can be resumed)."""
    with suppress(OSError, ValueError, TypeError):
        return TimedRun(**json.loads(path.read_text()))
    return None
