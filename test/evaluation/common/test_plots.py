"""Pictures have a line for everybody."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from matplotlib.figure import Figure

from rotavg_ros.evaluation.common import plots
from rotavg_ros.evaluation.common.training_plot import draw_together
from rotavg_ros.metrics import CalibrationBins

NAMES = [f"number {number}" for number in range(2 * len(plots.PALETTE))]


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """Figures that were saved."""
    figures: list[Figure] = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, _: figures.append(figure))
    return figures


def looks(figure: Figure, panel: int) -> dict[str, tuple[object, object]]:
    """Colour and style of a panel's named lines."""
    return {
        str(line.get_label()): (line.get_color(), line.get_linestyle())
        for line in figure.axes[panel].lines
        if not str(line.get_label()).startswith("_")
    }


def test_more_contenders_than_colours_are_all_drawn_and_differ(drawn: list[Figure]) -> None:
    bins = CalibrationBins()
    bins.add(torch.tensor([0.1, 0.9]), torch.tensor([False, True]))
    plots.reliability(Path("reliability.png"), dict.fromkeys(NAMES, bins), "Reliability")
    found = looks(drawn[0], 0)
    assert [name.partition(":")[0] for name in found] == NAMES
    assert len(set(found.values())) == len(NAMES)


def test_more_runs_than_colours_are_all_drawn_and_differ(drawn: list[Figure]) -> None:
    run = np.arange(1.0, 4.0), np.array([3.0, 1.0, 2.0])
    draw_together(Path("training.png"), {"CleanNet": dict.fromkeys(NAMES, run)})
    found = looks(drawn[0], 0)
    assert [*found] == NAMES
    assert len(set(found.values())) == len(NAMES)
