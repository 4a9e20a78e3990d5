"""Fit the one constant of the SfM profile's outlier score, so that the score is a probability.

`python -m rotavg_ros.training.score_fit` solves graphs of the training family, small and large, of seeds that nothing
else uses; it fits ``NeuroraNumbers.score_scale`` by maximum likelihood and prints the calibration error on further
graphs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from scipy.optimize import minimize_scalar
from torch import Tensor

from rotavg_ros.metrics import expected_calibration_error
from rotavg_ros.solver import solve
from rotavg_ros.solver.neurora.numbers import NUMBERS
from rotavg_ros.solver.neurora.scores import residual_and_uncertainty
from rotavg_ros.training.sfm_data import sample_graph

_SEED, _HELD_OUT_SEED = 70_001, 70_002
_GRAPHS_BY_NODES = {(60, 200): 12, (400, 600): 3}
_RECIPES = ("released", "released-spatial", "paper")


@dataclass(frozen=True)
class ScoreSample:
    """The edges of solved graphs of one kind.

    Attributes:
        excess: ``(M,)`` residual beyond the outlier angle, in units of the ends' uncertainty.
        is_outlier: ``(M,)`` bool.
    """

    kind: str
    excess: Tensor
    is_outlier: Tensor


def draw(seed: int, graphs_by_nodes: dict[tuple[int, int], int]) -> list[ScoreSample]:
    """Solve graphs of every recipe.

    Args:
        graphs_by_nodes: number of graphs by range of cameras.
    """
    rng = np.random.default_rng(seed)
    samples = []
    for recipe in _RECIPES:
        for nodes, count in graphs_by_nodes.items():
            rows = []
            for _ in range(count):
                sample = sample_graph(recipe, nodes, rng)
                solution = solve(sample.graph, profile="sfm")
                angle, uncertainty = residual_and_uncertainty(sample.graph, solution.body_from_world)
                rows.append(((angle - NUMBERS.outlier_angle) / uncertainty, sample.is_outlier))
            excess, is_outlier = (torch.cat(column) for column in zip(*rows, strict=True))
            samples.append(ScoreSample(f"{recipe}, {nodes[0]}–{nodes[1]} cameras", excess, is_outlier))
    return samples


def fit(samples: Sequence[ScoreSample]) -> float:
    """The scale with the greatest likelihood; every kind of graph has the same weight."""

    def loss(log_scale: float) -> float:
        return sum(
            float(
                torch.nn.functional.binary_cross_entropy_with_logits(
                    sample.excess / np.exp(log_scale), sample.is_outlier.double()
                )
            )
            for sample in samples
        )

    return float(np.exp(minimize_scalar(loss, bounds=(-4.0, 3.0), method="bounded").x))


def main() -> None:
    """Fit, and check on graphs that were not used for the fit."""
    scale = fit(draw(_SEED, _GRAPHS_BY_NODES))
    print(f"score_scale = {scale:.3f}")
    for sample in draw(_HELD_OUT_SEED, _GRAPHS_BY_NODES):
        error = expected_calibration_error(torch.sigmoid(sample.excess / scale), sample.is_outlier)
        print(f"{sample.kind}: expected calibration error {error:.4f}")


if __name__ == "__main__":
    main()
