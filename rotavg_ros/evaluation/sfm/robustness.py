"""The paper's robustness check (NeuRoRA, table 3): trained on one kind of graph, tested on another."""

from __future__ import annotations

from functools import partial

import numpy as np

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe
from rotavg_ros.evaluation.common.cases import Case, CaseKey, Kind
from rotavg_ros.evaluation.sfm import synthetic
from rotavg_ros.evaluation.sfm.published import ROBUSTNESS, Configuration, Robustness

# The table's rows in its order: what varies, and what it is in the graphs that are tested.
_NAMES = (
    *("cameras-250", "cameras-5000", "cameras-10000", "cameras-25000"),
    *("pairs-2.5", "pairs-25", "noise-10", "noise-30", "in-space", "planar"),
)
SETTINGS: dict[str, Robustness] = dict(zip(_NAMES, ROBUSTNESS, strict=True))
PAPER, CHATTERJEE, PIPELINE = METHODS = ("neurora-paper", "chatterjee", "neurora")
# degrees; the lower end of the text's range (§5.1), since the table only states the upper one.
_LEAST_NOISE_DEG = 5.0
# Largest number of graphs, from this number of cameras on: a large graph is worth many small ones, and slow to draw.
_FEWER = {10_000: 1, 5000: 3}
_STREAM = 0x0B57


def recipe_of(configuration: Configuration) -> PaperRecipe:
    """The recipe that draws a configuration's graphs, from the paper's text.

    Number of cameras, share of the pairs and share of the outliers are those stated, the same for every graph. "σ at
    most 30°" is read as in §5.1: a graph's σ is drawn uniformly from 5° to that. "In space": true orientations are
    uniform over all rotations, and the noise's axes over all directions.
    """
    pairs, outliers = configuration.pairs_percent / 100, configuration.outliers_percent / 100
    return PaperRecipe(
        cameras=(configuration.cameras, configuration.cameras),
        pair_share=(pairs, pairs),
        noise_deg=(_LEAST_NOISE_DEG, configuration.noise_deg),
        outlier_share=(outliers, outliers),
        planar=configuration.planar,
    )


def num_graphs(configuration: Configuration, count: int) -> int:
    """Number of graphs that are tested when ``count`` are requested."""
    return next((min(count, few) for cameras, few in _FEWER.items() if configuration.cameras >= cameras), count)


def methods_of(setting: str) -> tuple[str, ...]:
    """The methods for a setting's graphs, without one that takes hours and tens of gigabytes (as in the paper)."""
    return tuple(name for name in METHODS if name != CHATTERJEE or SETTINGS[setting].chatterjee is not None)


def kind(configuration: Configuration, seed: int) -> Kind:
    """Test graphs, counted from 0 in a run's ``seed``; settings that are tested on the same kind share them."""
    return Kind(str(configuration), partial(_draw, configuration, seed))


def _draw(configuration: Configuration, seed: int, number: int) -> Case:
    sample = recipe_of(configuration).sample(np.random.default_rng((seed, _STREAM, number)))
    return synthetic.case_of(CaseKey(f"{configuration}: {number}", str(configuration), seed), sample)
