from __future__ import annotations

import numpy as np
import pytest
import torch

from rotavg_ros.datasets.simulation.synthetic import PaperRecipe, ReleasedRecipe
from rotavg_ros.metrics import expected_calibration_error
from rotavg_ros.solver import solve
from rotavg_ros.training.score_fit import ScoreSample, draw, fit


def test_known_scale_is_recovered() -> None:
    excess = torch.linspace(-4, 4, 20_000, dtype=torch.float64)
    is_outlier = torch.rand(len(excess), generator=torch.Generator().manual_seed(0)) < torch.sigmoid(excess / 0.7)
    assert fit([ScoreSample("simulated", excess, is_outlier)]) == pytest.approx(0.7, rel=0.1)


def test_every_recipe_and_size_is_drawn() -> None:
    samples = draw(1, {(30, 40): 1, (50, 60): 1})
    assert len({sample.kind for sample in samples}) == 6
    assert all(bool(sample.is_outlier.any()) for sample in samples)


@pytest.mark.parametrize(
    "recipe",
    [
        ReleasedRecipe(cameras=(150, 250)),
        *(
            pytest.param(each, marks=pytest.mark.large)
            for each in (ReleasedRecipe(cameras=(150, 250), planar=False), PaperRecipe())
        ),
    ],
)
def test_published_score_is_a_probability(recipe: ReleasedRecipe | PaperRecipe) -> None:
    rng = np.random.default_rng(3)
    scores, outliers = [], []
    for _ in range(4):
        sample = recipe.sample(rng)
        scores.append(solve(sample.graph, profile="sfm").outlier_score)
        outliers.append(sample.is_outlier)
    assert expected_calibration_error(torch.cat(scores), torch.cat(outliers)) <= 0.03
