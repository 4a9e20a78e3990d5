"""Pictures of training runs: the validation's objective after every epoch."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure

from rotavg_ros.errors import UserError
from rotavg_ros.evaluation.common.plots import MUTED, PALETTE, line_of, style
from rotavg_ros.reports.theme import drawable


class TrainingLogError(UserError):
    """A log that cannot be drawn; the message names the file."""


def read_log(path: Path) -> tuple[np.ndarray, np.ndarray]:
    """Epochs ``(E,)`` from 1 and the validation's objective ``(E,)`` of a ``NAME.log.jsonl`` that training writes.

    Raises:
        TrainingLogError: unreadable, or not such a log.
    """
    try:
        rows = [json.loads(line) for line in path.read_text().splitlines()]
        epochs = np.array([row["epoch"] + 1 for row in rows], dtype=float)
        objective = np.array([row["validation_objective"] for row in rows], dtype=float)
    except OSError as error:
        raise TrainingLogError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, KeyError, TypeError):
        raise TrainingLogError(f"{path}: not a log of training (NAME.log.jsonl of `rotavg train`)") from None
    if len(epochs) == 0:
        raise TrainingLogError(f"{path}: has no epoch yet")
    return epochs, objective


def draw_training(path: Path, logs: Sequence[Path]) -> None:
    """A panel for each log, with its best epoch, whose weights are kept."""
    read = [(log, *read_log(log)) for log in logs]
    figure = Figure(figsize=(4.6 * len(read), 3.6), dpi=150, facecolor="white", layout="constrained")
    panels = figure.subplots(1, len(read), squeeze=False)[0]
    for axes, colour, (log, epochs, objective) in zip(panels, PALETTE * len(read), read, strict=False):
        best = int(objective.argmin())
        axes.plot(epochs, objective, color=colour, linewidth=1.2)
        axes.plot(epochs[best], objective[best], "o", color=colour, markersize=5)
        axes.annotate(
            f"epoch {epochs[best]:g}: {objective[best]:.3g}",
            (epochs[best], objective[best]),
            textcoords="offset points",
            xytext=(-4, 12),
            ha="right",
            fontsize=8,
            color=MUTED,
        )
        style(axes, drawable(log.name.removesuffix(".log.jsonl")).replace("$", r"\$"))  # no mathematics
        axes.set_xlabel("epoch", fontsize=9, color=MUTED)
        axes.set_ylabel("validation", fontsize=9, color=MUTED)
    figure.savefig(path)


def draw_together(path: Path, runs_of: Mapping[str, Mapping[str, tuple[np.ndarray, np.ndarray]]]) -> None:
    """A panel for each kind of network, with a curve for each run of it, over the share of its epochs.

    Args:
        runs_of: epochs ``(E,)`` from 1 and objectives ``(E,)``, by what is said of the run, by the panel's title.
    """
    figure = Figure(figsize=(4.6 * len(runs_of), 3.6), dpi=110, facecolor="white", layout="constrained")
    panels = figure.subplots(1, len(runs_of), squeeze=False)[0]
    for axes, (title, runs) in zip(panels, runs_of.items(), strict=True):
        for number, (label, (epochs, objective)) in enumerate(runs.items()):
            best, share = int(objective.argmin()), epochs / epochs[-1]
            (line,) = axes.plot(share, objective, **line_of(number), linewidth=1.0, label=label)
            axes.plot(share[best], objective[best], "o", color=line.get_color(), markersize=4)
        axes.set_yscale("log")
        style(axes, title)
        axes.set_xlabel("share of the epochs", fontsize=9, color=MUTED)
    # Below, where no curve is; a run has the same colour in all panels.
    lines = {line.get_label(): line for axes in panels for line in axes.lines if line.get_label() in _labels(runs_of)}
    figure.legend(lines.values(), lines, loc="outside lower center", ncols=len(panels), frameon=False, fontsize=7)
    figure.savefig(path)


def _labels(runs_of: Mapping[str, Mapping[str, object]]) -> set[str]:
    return {label for runs in runs_of.values() for label in runs}
