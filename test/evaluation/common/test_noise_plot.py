"""What the noise of a view-graph looks like."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from rotavg_ros.datasets.simulation.synthetic import ReleasedRecipe
from rotavg_ros.evaluation.common.noise_plot import draw, edge_noise


def test_noise_of_a_synthetic_graph_is_its_own() -> None:
    sample = ReleasedRecipe(cameras=(40, 40)).sample(np.random.default_rng(0))
    noise = edge_noise(sample.graph, sample.body_from_world)
    np.testing.assert_allclose(noise.angle_deg, np.degrees(sample.noise_angle.numpy()), atol=1e-6)
    # The recipe's noise axes lie in the plane z = 0, but for its tenth about any axis.
    assert np.nanmedian(np.abs(noise.axis[:, 2])) < 0.15
    assert not noise.is_residual
    assert edge_noise(sample.graph, None).is_residual


def test_a_title_in_letters_that_the_font_lacks_is_drawn_without_a_warning(tmp_path: Path) -> None:
    sample = ReleasedRecipe(cameras=(10, 10)).sample(np.random.default_rng(0))
    draw(tmp_path / "noise.png", edge_noise(sample.graph, sample.body_from_world), "ロボット.g2o", 20.0)
    assert (tmp_path / "noise.png").stat().st_size > 0
